for (const button of document.querySelectorAll("th button")) {
  button.addEventListener("click", () => {
    const head = button.parentElement, column = head.cellIndex, body = head.closest("table").tBodies[0];
    const sign = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
    const key = row => row.cells[column].dataset.sort ?? row.cells[column].textContent;
    const empty = row => row.cells[column].textContent === "–";
    const numeric = head.classList.contains("number");
    const rows = [...body.rows].sort((a, b) => {
      if (empty(a) || empty(b)) return empty(a) - empty(b);
      return sign * (numeric ? key(a) - key(b) : key(a).localeCompare(key(b), "en", {numeric: true}));
    });
    for (const other of head.parentElement.cells) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
    body.append(...rows);
  });
}

// What a link leads to may lie in a closed fold.
const unfold = () => {
  const target = location.hash && document.getElementById(location.hash.slice(1));
  if (!target) return;
  const around = target.closest("details");
  for (const folded of [...(around ? [around] : []), ...target.querySelectorAll("details")]) folded.open = true;
  if (around) target.scrollIntoView();
};
addEventListener("hashchange", unfold);
unfold();

// The numbers of a point at once, and where a finger cannot hover; without scripts browsers show the titles.
const tip = document.createElement("div");
tip.className = "tip";
document.body.append(tip);
for (const title of document.querySelectorAll("circle.hover title")) {
  const point = title.parentElement;
  point.dataset.tip = title.textContent;
  title.remove();
}
const show = event => {
  const text = event.target.dataset && event.target.dataset.tip;
  tip.textContent = text || "";
  tip.style.display = text ? "block" : "none";
  if (!text) return;
  tip.style.left = `${Math.max(4, Math.min(event.clientX + 12, innerWidth - tip.offsetWidth - 8))}px`;
  tip.style.top = `${Math.max(4, event.clientY - tip.offsetHeight - 10)}px`;
};
addEventListener("pointerover", show);
addEventListener("pointerdown", show);
