"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const get = (id) => document.getElementById(id);
const make = (tag, text = "", more = {}) => Object.assign(document.createElement(tag), { textContent: text }, more);
const unique = (values) => [...new Set(values)];
const fill = (select, pairs) => {
  const before = select.value;
  select.replaceChildren(...pairs.map(([value, text]) => make("option", text, { value })));
  if (pairs.some(([value]) => value === before)) select.value = before;
};
const number = (value, decimals) => (value === null || value === undefined ? "n/a" : value.toFixed(decimals));
const large = (value) => (value >= 1e6 ? `${(value / 1e6).toPrecision(3)} M` : value.toFixed(0));

// The table: rows of a scene and protocol, sorted by the column whose head is pressed; what has no value comes last.
const named = (names) => names.map((name) => [name, name]);
const sort = { key: "psnr", up: false };
const region = (name) => (name === "iou" || (name === "lpips" && get("region").value !== "release_crop") ? "full" : get("region").value);
const score = (row, name) => row.scores[get("split").value]?.[`${region(name)}/${name}`] ?? null;
const cost = (row, name) => (row.machine === get("machine").value || !["frame_ms", "train_s"].includes(name) ? row.costs[name] : null);
const columns = () => [
  { key: "method", title: "method" },
  ...(get("scene").value ? [] : [{ key: "scene", title: "scene", words: true }]),
  ...data.qualities.map((key) => ({ key, ...data.metrics[key], of: score, where: region(key) === "full" && get("region").value !== "full" ? " (whole frame)" : "" })),
  ...data.costs.map(([key, metric]) => ({ key, ...metric, of: cost })),
  { key: "over", title: "mean of" },
];
const cellOf = (row, column) => {
  if (column.key === "method") {
    const head = make("th", row.method, { scope: "row" }), cell = data.cells.find((each) => each.name === row.cell), link = make("small");
    link.append(make("a", cell.pictures ? "pictures" : "values by image", { href: `#${row.cell}` }));
    if (cell.views.length) link.append(" · ");
    else link.replaceChildren();
    link.append(row.origin);
    head.append(link);
    return head;
  }
  if (column.words) return make("td", row[column.key], { className: "scene" });
  if (!column.of) return make("td", row[column.key]);
  const value = column.of(row, column.key);
  if (!value) return make("td", "n/a", { title: row.machine && column.of === cost ? `on ${row.machine}` : "not measured" });
  const text = value[0] >= 1e4 ? large(value[0]) : number(value[0], column.decimals);
  return make("td", !value[1] ? text : `${text} ± ${number(value[1], column.decimals)}`);
};
const showBoard = () => {
  const rows = data.rows.filter((row) => row.protocol === get("protocol").value && [row.scene, ""].includes(get("scene").value));
  const shown = columns(), by = shown.find((column) => column.key === sort.key) ?? shown[0];
  const value = (row) => (by.of ? (by.of(row, by.key)?.[0] ?? null) : row[by.key]);
  rows.sort((a, b) => {
    const x = value(a), y = value(b);
    if (x === null || y === null) return (x === null) - (y === null);
    return (sort.up ? 1 : -1) * (typeof x === "string" ? x.localeCompare(y) : x - y);
  });
  const heads = shown.map((column) => {
    const head = make("th", "", { scope: "col", className: column.words ? "text" : "" }), button = make("button", column.title + (column.where ?? ""), { type: "button" });
    if (column === by) head.setAttribute("aria-sort", sort.up ? "ascending" : "descending");
    button.addEventListener("click", () => {
      Object.assign(sort, { key: column.key, up: sort.key === column.key ? !sort.up : !column.up });
      showBoard();
    });
    head.append(button);
    return head;
  });
  const line = (cells) => { const row = make("tr"); row.append(...cells); return row; };
  get("board").tHead.replaceChildren(line(heads));
  get("board").tBodies[0].replaceChildren(...rows.map((row) => line(shown.map((column) => cellOf(row, column)))));
  const others = unique(rows.map((row) => row.machine)).filter((name) => name && name !== get("machine").value);
  get("hint").textContent = others.length ? `Milliseconds and training seconds on ${others.join("; ")} are not shown: they do not compare.` : "";
};

// The viewer: truth, then each method with its picture, its error and its values.
const cellsShown = () => data.cells.filter((cell) => cell.capture === get("capture").value && [cell.name, ""].includes(get("method").value));
const [SPLIT, CAMERA, FRAME, FIRST] = [0, 1, 2, 3];
const path = (...parts) => parts.map((part) => part.split("/").map(encodeURIComponent).join("/")).join("/");
const frameName = (frame) => (frame < 0 ? `-${String(-frame).padStart(5, "0")}` : String(frame).padStart(6, "0"));
const frames = () => unique(viewsShown().filter((view) => view[SPLIT] === get("images").value && view[CAMERA] === get("camera").value).map((view) => view[FRAME])).sort((a, b) => a - b);
const many = unique(data.cells.map((cell) => cell.source)).length > 1;
const titleOf = (cell) => cell.title + (many ? ` (${cell.source})` : "");
const viewsShown = () => cellsShown().flatMap((cell) => cell.views);
const picture = (address, alt) => {
  const image = make("img", "", { src: address, alt });
  image.addEventListener("load", () => { image.style.width = `${image.naturalWidth * get("zoom").value}px`; });
  return image;
};
const tile = (images, name = "tile") => { const box = make("div", "", { className: name }); box.append(...images); return box; };
const choices = () => {
  const cells = data.cells.filter((cell) => cell.capture === get("capture").value && cell.views.length);
  fill(get("method"), [["", "all side by side"], ...cells.map((cell) => [cell.name, titleOf(cell)])]);
  const splits = unique(viewsShown().map((view) => view[SPLIT]));
  fill(get("images"), data.splits.filter(([split]) => splits.includes(split)));
  fill(get("camera"), named(unique(viewsShown().filter((view) => view[SPLIT] === get("images").value).map((view) => view[CAMERA]))));
  get("frame").max = Math.max(0, frames().length - 1);
  showPictures();
};
const showPictures = () => {
  const [split, camera, frame] = [get("images").value, get("camera").value, frames()[get("frame").value]];
  get("number").textContent = frame ?? "";
  const strip = get("strip"), rows = [], file = frame === undefined ? "" : `${frameName(frame)}.png`;
  const figures = cellsShown().flatMap((cell) => {
    const view = cell.views.find((each) => each[SPLIT] === split && each[CAMERA] === camera && each[FRAME] === frame);
    if (!view) return [];
    const value = (name) => view[FIRST + data.scores.indexOf(name)] ?? null;
    rows.push([titleOf(cell), ...data.scores.map((name) => number(value(name), data.metrics[name.split("/")[1]].decimals))]);
    const figure = make("figure"), caption = make("figcaption", titleOf(cell)), psnr = value("foreground/psnr") ?? value("full/psnr");
    caption.append(make("span", `${number(psnr, 2)} dB`));
    figure.append(caption);
    if (!cell.pictures) { figure.append(make("p", "its source holds no pictures", { className: "note" })); return [figure]; }
    const own = path(cell.pictures, split, camera, file), truth = cell.truth && path(cell.truth, camera, file);
    figure.append(tile([picture(own, `${cell.title}, as scored`)]));
    if (truth) figure.append(tile([picture(truth, ""), picture(own, `${cell.title}: error`)], "tile error"));
    figure.append(make("a", "download", { href: own, download: `${cell.name}_${split}_${camera}_${file}` }));
    return [figure];
  });
  const truth = cellsShown().map((cell) => cell.truth).find((each) => each);
  const first = make("figure", "", { className: "truth" });
  first.append(make("figcaption", "Truth"));
  if (truth && file) {
    const address = path(truth, camera, file);
    first.append(tile([picture(address, "Truth")]), make("a", "download", { href: address, download: `truth_${camera}_${file}` }));
  } else first.append(make("p", file ? "the capture was not at hand" : "no images", { className: "note" }));
  strip.style.setProperty("--gain", get("gain").value);
  strip.replaceChildren(first, ...figures);
  const groups = make("tr"), head = make("tr"), regionOf = (name) => name.split("/")[0];
  groups.append(make("td"));
  for (const where of unique(data.scores.map(regionOf))) {
    const group = make("th", "", { className: "group", colSpan: data.scores.filter((name) => regionOf(name) === where).length, scope: "colgroup" });
    group.append(make("span", Object.fromEntries(data.regions)[where] ?? "pose"));
    groups.append(group);
  }
  head.append(make("th", "this image"), ...data.scores.map((name) => make("th", data.metrics[name.split("/")[1]].title, { scope: "col" })));
  get("values").tHead.replaceChildren(groups, head);
  get("values").tBodies[0].replaceChildren(...rows.map(([name, ...values]) => {
    const row = make("tr");
    row.append(make("th", name, { scope: "row" }), ...values.map((value) => make("td", value)));
    return row;
  }));
};
const address = () => history.replaceState(null, "", `#${path(get("method").value || data.cells.find((cell) => cell.capture === get("capture").value).name, get("images").value, get("camera").value, String(frames()[get("frame").value]))}${get("method").value ? "" : "/all"}`);
const follow = () => {
  const [name, split, camera, frame, all] = location.hash.slice(1).split("/").map(decodeURIComponent);
  const cell = data.cells.find((each) => each.name === name);
  if (!cell) return;
  get("capture").value = cell.capture; choices();
  get("method").value = all ? "" : name; choices();
  if (split) { get("images").value = split; choices(); get("camera").value = camera; choices(); }
  get("frame").value = Math.max(0, frames().indexOf(Number(frame))); showPictures();
  get("pictures").scrollIntoView();
};

const machines = data.rows.map((row) => row.machine).filter(Boolean);
const often = (name) => machines.filter((each) => each === name).length;
const scenes = unique(data.rows.map((row) => row.scene));
fill(get("scene"), [...named(scenes), ...(scenes.length > 1 ? [["", "all (they do not compare)"]] : [])]);
fill(get("protocol"), named(unique(data.rows.map((row) => row.protocol))));
fill(get("split"), data.splits.filter(([split]) => data.rows.some((row) => split in row.scores)));
fill(get("region"), data.regions);
fill(get("machine"), machines.length ? named(unique(machines).sort((a, b) => often(b) - often(a))) : [["", "none: nothing was timed"]]);
fill(get("capture"), named(unique(data.cells.map((cell) => cell.capture))));
if (data.rows.some((row) => "novel_view" in row.scores)) get("split").value = "novel_view";
for (const id of ["scene", "protocol", "split", "region", "machine"]) get(id).addEventListener("change", showBoard);
for (const id of ["capture", "method", "images", "camera"]) get(id).addEventListener("change", () => { choices(); address(); });
for (const id of ["frame", "zoom", "gain"]) get(id).addEventListener("input", () => { showPictures(); address(); });
const step = (by) => { get("frame").value = Number(get("frame").value) + by; showPictures(); address(); };
for (const button of document.querySelectorAll("[data-step]")) button.addEventListener("click", () => step(Number(button.dataset.step)));
get("viewer").addEventListener("keydown", (event) => {
  const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
  if (by && !event.target.closest("input, select")) { event.preventDefault(); step(by); }
});
addEventListener("hashchange", follow);
if (innerWidth < 600) get("zoom").value = 1;
showBoard();
choices();
get("images").value = get("split").value;
choices();
follow();
