// What viser's page does not do by itself. Before this come LABEL, the panel's title, and DIVIDER, the slider's id.
document.title = LABEL;
const NARROW = 576; // CSS pixels, below which viser puts its panel at the bottom

const style = document.createElement("style");
style.textContent = `
  /* Contrast of at least 4.5, which viser's own colours have not. */
  :root { --mantine-color-dimmed: #5a6472 !important; --strong: #2459b8; }
  :root[data-mantine-color-scheme="dark"] { --mantine-color-dimmed: #a7afbb !important; --strong: #8fb4ff; }
  [role=tab][aria-selected=true] *, .mantine-Button-root[data-variant=outline] .mantine-Button-label { color: var(--strong) !important; }
  .mantine-Button-root:not([data-variant]) { background: #2459b8 !important; }
  .mantine-Slider-markLabel { color: var(--mantine-color-dimmed) !important; }
  #split { position: fixed; display: none; width: 44px; margin-left: -22px; cursor: ew-resize; touch-action: none; z-index: 5; }
  #split i { position: absolute; top: 50%; left: 9px; width: 26px; height: 26px; margin-top: -13px; border-radius: 50%;
    background: #fff; color: #14191f; font: 13px/26px system-ui, sans-serif; text-align: center; box-shadow: 0 0 4px #0008; }
  #split:focus-visible i { outline: 3px solid #2f6fde; }
  @media (max-width: ${NARROW}px) { [style*="width: 20em"] { width: 100% !important; } }`;
document.head.append(style);

// The divider: a handle over the picture, which types into the number box of the slider, so that both stay one.
const handle = document.createElement("div");
handle.id = "split";
handle.title = "Drag to compare";
handle.innerHTML = "<i>⇔</i>";
document.body.append(handle);
const write = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set;
const box = () => document.getElementById(DIVIDER)?.parentElement.querySelector("input[inputmode]");
let held = null; // where the pointer has it, a share of the picture's width

function place() {
  const canvas = document.querySelector("canvas")?.getBoundingClientRect(), number = box();
  handle.style.display = canvas && number ? "block" : "none";
  if (canvas && number) {
    const share = held ?? Number(number.value);
    Object.assign(handle.style, {
      left: `${canvas.left + share * canvas.width}px`, top: `${canvas.top}px`, height: `${canvas.height}px` });
  }
  requestAnimationFrame(place);
}
function drag(event) {
  if (held === null) return;
  const canvas = document.querySelector("canvas").getBoundingClientRect(), number = box();
  held = Math.min(1, Math.max(0, (event.clientX - canvas.left) / canvas.width));
  if (!number) return;
  write.call(number, held.toFixed(3));
  number.dispatchEvent(new Event("input", { bubbles: true }));
  number.blur(); // In a box, keys would be letters.
}
handle.onpointerdown = (event) => { handle.setPointerCapture(event.pointerId); held = 0; drag(event); };
handle.onpointermove = drag;
handle.onpointerup = handle.onpointercancel = () => { held = null; };
place();

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

// Light and dark as the system has it, until the viewer says otherwise: by the same keys.
const dark = matchMedia("(prefers-color-scheme: dark)");
function follow(tries) {
  const shown = document.documentElement.getAttribute("data-mantine-color-scheme") === "dark";
  if (shown === dark.matches || !tries) return;
  press(dark.matches ? "d" : "l");
  setTimeout(follow, 300, tries - 1);
}
dark.addEventListener("change", () => follow(10));
follow(200);

// On a narrow screen viser opens its panel over the person; a touch on its bar opens it again. A slow phone may take a minute to show it.
function fold(tries) {
  const bar = [...document.body.querySelectorAll("*")].find((e) => !e.childElementCount && e.textContent === LABEL);
  if (bar) bar.click();
  else if (tries) setTimeout(fold, 200, tries - 1);
}
if (window.innerWidth < NARROW) setTimeout(fold, 800, 300);

// viser warns of slow graphics; here the server draws, and the warning would lie over the person.
const warned = new MutationObserver(() => {
  for (const note of document.querySelectorAll("[role=alert]"))
    if (note.textContent.includes("Software WebGL")) { note.querySelector("button")?.click(); warned.disconnect(); }
});
warned.observe(document.body, { childList: true, subtree: true });
setTimeout(() => warned.disconnect(), 20000);
