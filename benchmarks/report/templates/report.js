"use strict";
const read = (element) => JSON.parse(element.textContent);
const album = (() => { let pictures; return (key) => (pictures ??= read(document.getElementById("album")))[key]; })();
const paint = (image, key) => {
  if (image.dataset.shown !== String(key)) { image.dataset.shown = key; image.src = "data:image/webp;base64," + album(key); }
};
const whenSeen = (elements, act) => {
  const observer = new IntersectionObserver((entries) => {
    for (const entry of entries) if (entry.isIntersecting) { observer.unobserve(entry.target); act(entry.target); }
  }, { rootMargin: "400px" });
  for (const element of elements) observer.observe(element);
};

// Tables sort by the column whose head is pressed; what is not a number comes last.
for (const button of document.querySelectorAll("thead button")) {
  button.addEventListener("click", () => {
    const head = button.closest("th"), body = head.closest("table").tBodies[0];
    const column = [...head.parentNode.children].indexOf(head);
    const up = head.getAttribute("aria-sort") !== "ascending";
    for (const other of head.parentNode.children) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", up ? "ascending" : "descending");
    const value = (row) => {
      const text = row.cells[column].textContent, number = /^[+-]?[\d.]+([kM]?)/.exec(text);
      return column === 0 ? text : number ? parseFloat(text) * { "": 1, k: 1e3, M: 1e6 }[number[1]] : null;
    };
    const rows = [...body.rows].sort((a, b) => {
      const x = value(a), y = value(b);
      if (x === null || y === null) return (x === null) - (y === null);
      const order = typeof x === "string" ? x.localeCompare(y) : x - y;
      return up ? order : -order;
    });
    for (const row of rows) { row.classList.remove("first"); body.append(row); }
  });
}

// Charts: drawn when they come into sight or are printed, without eval; the legend's buttons hide and show series in all panels.
const views = new Map();
const draw = async (box) => {
  if (box.dataset.begun) return;
  box.dataset.begun = "yes";
  const theme = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
  const options = { mode: "vega-lite", ast: true, renderer: "svg", actions: false, tooltip: { theme } };
  const spec = read(box.querySelector("script"));
  const { view } = await vegaEmbed(box, spec, options);
  views.set(box, view);
  box.dispatchEvent(new Event("drawn"));
  box.dataset.drawn = "yes";
};
whenSeen(document.querySelectorAll(".panels > .vega"), draw);
for (const figure of document.querySelectorAll("[data-chart]")) {
  const boxes = [...figure.querySelectorAll(".panels > .vega")], buttons = [...figure.querySelectorAll(".legend button")];
  const apply = () => {
    const hidden = buttons.filter((b) => b.getAttribute("aria-pressed") === "false").map((b) => b.dataset.series);
    for (const box of boxes) views.get(box)?.signal("hidden", hidden).runAsync();
  };
  for (const box of boxes) box.addEventListener("drawn", apply);
  for (const button of buttons) button.addEventListener("click", () => {
    button.setAttribute("aria-pressed", button.getAttribute("aria-pressed") === "false");
    apply();
  });
}

// Pictures: one moment of one camera at a time; all methods in a strip, two of them on one stage.
const setUp = (box) => {
  if (box.dataset.begun) return;
  box.dataset.begun = "yes";
  const find = (name) => box.querySelector(`[data-${name}]`);
  const { tracks, names } = read(box.querySelector("script"));
  const [track, frame, number, left, right, zoom, edge] =
    ["track", "frame", "number", "left", "right", "zoom", "edge"].map(find);
  const under = find("under"), over = find("over"), strip = find("strip"), slider = box.querySelector(".slider");
  const chart = find("frames").querySelector(".panels > .vega");
  const now = () => tracks[track.value];
  const keys = () => [now().truth, ...now().pictures];
  const tiles = ["Truth", ...names].map((name, index) => {
    const figure = document.createElement("figure"), caption = document.createElement("figcaption");
    const score = document.createElement("span"), button = document.createElement("button");
    const picture = new Image(), reference = new Image();
    caption.append(name, score);
    picture.alt = name; reference.alt = ""; reference.className = "reference";
    button.type = "button"; button.className = "picture"; button.append(picture);
    button.setAttribute("aria-label", `${name} on the right`);
    if (index) button.append(reference); else figure.className = "truth";
    button.addEventListener("click", () => { right.selectedIndex = index; show(); });
    figure.append(caption, button);
    strip.append(figure);
    return { score, picture, reference };
  });
  const show = () => {
    const at = Number(frame.value), all = keys();
    number.textContent = now().frames[at];
    tiles.forEach((tile, index) => {
      paint(tile.picture, all[index][at]);
      if (index) paint(tile.reference, all[0][at]);
      tile.score.textContent = index ? `${now().psnr[index - 1][at].toFixed(1)} dB` : "\u00a0";
    });
    paint(over, all[left.selectedIndex][at]);
    paint(under, all[right.selectedIndex][at]);
    over.width = under.width = now().width * zoom.value;
    over.height = under.height = now().height * zoom.value;
    for (const tile of tiles) for (const image of [tile.picture, tile.reference]) image.style.setProperty("--wide", now().width);
    views.get(chart)?.signal("track", Number(track.value)).signal("frame", now().frames[at]).runAsync();
  };
  const begin = () => { frame.max = now().frames.length - 1; frame.value = 0; show(); };
  const step = (by) => { frame.value = Number(frame.value) + by; show(); };
  const cut = (percent) => { slider.style.setProperty("--cut", percent + "%"); edge.value = percent; };
  const room = box.clientWidth, tall = Math.min(640, innerHeight * 0.75);
  const fitting = [...zoom.options].filter((o) => o.value * now().width <= room && o.value * now().height <= Math.max(tall, now().height));
  zoom.value = fitting.length ? fitting.at(-1).value : 1;
  track.addEventListener("change", begin);
  frame.addEventListener("input", show);
  for (const select of [left, right, zoom]) select.addEventListener("change", show);
  for (const button of box.querySelectorAll("[data-step]")) button.addEventListener("click", () => step(Number(button.dataset.step)));
  box.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (by && !event.target.closest("input, select")) { event.preventDefault(); step(by); }
  });
  edge.addEventListener("input", () => cut(edge.value));
  slider.addEventListener("pointermove", (event) => {
    if (event.pointerType !== "mouse" && !event.buttons) return;
    const frame = slider.getBoundingClientRect();
    cut(Math.min(100, Math.max(0, (100 * (event.clientX - frame.left)) / frame.width)));
  });
  find("difference").addEventListener("change", (event) => strip.classList.toggle("difference", event.target.checked));
  const follow = () => {
    const view = views.get(chart);
    show();
    view.addEventListener("click", (event) => {
      const x = event.clientX - chart.querySelector("svg").getBoundingClientRect().left - view.origin()[0];
      const wanted = view.scale("x").invert(x), far = (each) => Math.abs(each - wanted);
      frame.value = now().frames.reduce((best, each, index, all) => (far(each) < far(all[best]) ? index : best), 0);
      show();
    });
  };
  if (views.has(chart)) follow(); else chart.addEventListener("drawn", follow);
  begin();
};
whenSeen(document.querySelectorAll("[data-player]"), setUp);
whenSeen(document.querySelectorAll("img[data-picture]"), (image) => paint(image, image.dataset.picture));
// Any picture at its full size; a click or the wheel enlarges it.
const full = document.getElementById("full"), big = new Image();
const enlarge = (times) => {
  big.dataset.zoom = Math.min(8, Math.max(1, big.dataset.zoom * times));
  big.width = big.naturalWidth * big.dataset.zoom;
};
for (const image of document.querySelectorAll("img[data-picture]")) {
  const open = async () => {
    big.src = image.src; big.alt = image.alt;
    await big.decode();
    big.dataset.zoom = Math.max(1, Math.floor(Math.min(innerWidth / 2 / big.naturalWidth, innerHeight / 2 / big.naturalHeight)));
    enlarge(1); full.append(big); full.showModal();
  };
  image.addEventListener("click", open);
  image.addEventListener("keydown", (event) => { if (event.key === "Enter") open(); });
}
big.addEventListener("click", () => enlarge(2));
big.addEventListener("wheel", (event) => { event.preventDefault(); enlarge(event.deltaY < 0 ? 1.25 : 0.8); }, { passive: false });
// What is lazy comes soon after the page is there, so that a print or a PDF is whole; folded parts print unfolded.
const lazy = [...document.querySelectorAll(".panels > .vega")];
const rest = async () => {
  for (const box of lazy) if (box.clientWidth) { await draw(box); await new Promise((done) => setTimeout(done)); }
};
(window.requestIdleCallback ?? setTimeout)(rest);
addEventListener("beforeprint", () => {
  for (const fold of document.querySelectorAll("details:not([open])")) { fold.open = true; fold.dataset.folded = "yes"; }
  document.querySelectorAll("img[data-picture]").forEach((image) => paint(image, image.dataset.picture));
  document.querySelectorAll("[data-player]").forEach(setUp);
  lazy.forEach(draw);
});
addEventListener("afterprint", () => {
  for (const fold of document.querySelectorAll("details[data-folded]")) { fold.open = false; delete fold.dataset.folded; }
});
for (const link of document.querySelectorAll("a.term")) {
  link.addEventListener("click", () => {
    const fold = document.querySelector(link.hash)?.closest("details");
    if (fold) fold.open = true;
  });
}
