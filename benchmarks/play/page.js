// What viser's page does not do by itself. Before this comes LABEL, the panel's title.
document.title = LABEL;

const style = document.createElement("style");
style.textContent = `
  /* Contrast of at least 4.5, which viser's own colours have not. */
  :root { --mantine-color-dimmed: #5a6472 !important; }
  [role=tab][aria-selected=true] *, .mantine-Button-root[data-variant=outline] .mantine-Button-label { color: #2459b8 !important; }
  .mantine-Button-root:not([data-variant]) { background: #2459b8 !important; }
  .mantine-Slider-markLabel { color: var(--mantine-color-dimmed) !important; }`;
document.head.append(style);

// Keys belong to the player, not to viser's camera: they are stopped here and sent on by name alone, which only the
// player's commands hear. What is typed into a control, or moves it, stays the control's.
function press(key) {
  return document.documentElement.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true }));
}
function keeps(control, key) {
  if (control.matches("input[type=checkbox]")) return key === " ";
  if (control.matches("[role=slider], [role=tab]")) return key.startsWith("Arrow");
  return control.matches("input, textarea, [contenteditable]");
}
document.body.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  event.stopPropagation();
  if (!keeps(event.target, event.key) && !press(event.key)) event.preventDefault();
});

// viser warns of slow graphics; here the server draws, and the warning would lie over the person.
const warned = new MutationObserver(() => {
  for (const note of document.querySelectorAll("[role=alert]"))
    if (note.textContent.includes("Software WebGL")) { note.querySelector("button")?.click(); warned.disconnect(); }
});
warned.observe(document.body, { childList: true, subtree: true });
setTimeout(() => warned.disconnect(), 20000);
