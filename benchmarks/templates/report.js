for (const button of document.querySelectorAll("thead button")) {
  button.addEventListener("click", () => {
    const head = button.closest("th"), table = button.closest("table"), body = table.tBodies[0];
    const column = [...head.parentNode.children].indexOf(head);
    const up = head.getAttribute("aria-sort") !== "ascending";
    for (const other of head.parentNode.children) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", up ? "ascending" : "descending");
    const value = (row) => {
      const cell = row.cells[column];
      return column === 0 ? cell.textContent : cell.dataset.value === "" ? null : Number(cell.dataset.value);
    };
    const rows = [...body.rows].sort((a, b) => {
      const x = value(a), y = value(b);
      if (x === null || y === null) return (x === null) - (y === null);
      const order = typeof x === "string" ? x.localeCompare(y) : x - y;
      return up ? order : -order;
    });
    for (const row of rows) { row.classList.remove("apart"); body.append(row); }
  });
}
for (const box of document.querySelectorAll("[data-compare]")) {
  const slider = box.querySelector(".slider"), [under, over] = slider.querySelectorAll("img");
  const [view, left, right] = box.querySelectorAll("select");
  const range = box.querySelector("input");
  const tiles = () => document.getElementById(view.value).querySelectorAll(".tiles img");
  const show = () => {
    const found = tiles();
    over.src = found[left.selectedIndex].src;
    under.src = found[right.selectedIndex].src;
    under.width = over.width = 3 * found[0].naturalWidth || found[0].width * 1.5;
  };
  const cut = (percent) => { slider.style.setProperty("--cut", percent + "%"); range.value = percent; };
  for (const select of [view, left, right]) select.addEventListener("change", show);
  range.addEventListener("input", () => cut(range.value));
  slider.addEventListener("pointermove", (event) => {
    const frame = slider.getBoundingClientRect();
    cut(Math.min(100, Math.max(0, (100 * (event.clientX - frame.left)) / frame.width)));
  });
  show();
}
