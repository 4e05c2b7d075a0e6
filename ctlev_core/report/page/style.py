"""How the report looks, and the few lines of script that sort its tables and open what a link leads to."""

STYLE = """
:root { color-scheme: light dark; --page: #fff; --ink: #1c2024; --soft: #5d6670; --line: #dfe3e7; --tint: #f5f7f9;
  --accent: #2f6fca; }
@media (prefers-color-scheme: dark) {
  :root { --page: #15181c; --ink: #e4e7ea; --soft: #9aa4ae; --line: #30363d; --tint: #1d2126; --accent: #7fb0f5; }
}
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
main { max-width: 1060px; margin: 0 auto; padding: 2.2rem 1.25rem 4rem; }
h1 { font-size: 1.75rem; line-height: 1.25; margin: 0 0 .6rem; letter-spacing: -.01em; }
h2 { font-size: 1.15rem; line-height: 1.35; margin: 0 0 .4rem; }
h3 { font-size: 1rem; line-height: 1.35; margin: 1.6rem 0 .4rem; }
details { border-top: 1px solid var(--line); padding-top: .6rem; }
summary { cursor: pointer; color: var(--accent); }
summary h2 { display: inline; color: var(--ink); }
details[open] > summary { margin-bottom: .6rem; }
p { margin: 0 0 .7rem; max-width: 75ch; }
section { margin-top: 2.6rem; }
code { font: .88em ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; background: var(--tint);
  padding: .08em .3em; border-radius: 3px; }
a { color: var(--accent); text-decoration: none; }
a:hover { text-decoration: underline; }
.lead, .caption, footer { color: var(--soft); }
.caption, .footnotes { font-size: .9rem; }
.verdict { border-left: 3px solid var(--accent); padding: .1rem 0 .1rem 1rem; margin: 1.1rem 0; font-size: 1.08rem; }
.verdict p:last-child { margin-bottom: 0; }
.empty { color: var(--soft); font-style: italic; }
.steps { display: grid; grid-template-columns: repeat(4, 1fr); gap: 1.2rem 2.2rem;
  margin: 1.6rem 0; padding: 0; list-style: none; max-width: 58rem; }
.steps .picture { position: relative; }
.steps figure { margin: 0; }
.steps img, .steps .words { display: block; width: 100%; aspect-ratio: 1; object-fit: contain; background: #000;
  border-radius: 4px; image-rendering: pixelated; }
.steps .words { margin: 0; display: flex; align-items: center; justify-content: center; padding: 1rem;
  text-align: center; background: var(--tint); border: 1px solid var(--line); font-size: 1.05rem; }
.steps figcaption { font-size: .85rem; line-height: 1.4; color: var(--soft); margin-top: .45rem; }
.steps b { display: block; color: var(--ink); }
.steps .follows .picture::before { content: "→"; position: absolute; left: -2.2rem; width: 2.2rem; text-align: center;
  top: calc(50% - .5em); font-size: 1.3rem; line-height: 1; color: var(--soft); }
nav ol { margin: 1.2rem 0 0; padding: 0; list-style: none; font-size: .9rem; columns: 18rem auto; column-gap: 2rem; }
nav li { break-inside: avoid; padding: .1rem 0; }
.scroll { overflow-x: auto; }
.scroll:focus-visible { outline: 2px solid var(--accent); outline-offset: 3px; }
table { border-collapse: collapse; font-size: .92rem; line-height: 1.4; min-width: min(100%, 30rem);
  font-variant-numeric: tabular-nums; }
th, td { padding: .36rem .8rem; text-align: left; vertical-align: baseline; border-bottom: 1px solid var(--line); }
th { padding-top: 0; border-bottom: 1.5px solid var(--soft); vertical-align: bottom; font-weight: 600; }
th:first-child, td:first-child { padding-left: 0; }
th:first-child, td:first-child { position: sticky; left: 0; background: var(--page); }
tbody tr:hover td:first-child { background: var(--tint); }
td.number { white-space: nowrap; }
.number, .number button { text-align: right; }
tbody tr:hover { background: var(--tint); }
.bold { font-weight: 700; }
.uncertainty { color: var(--soft); font-weight: 400; font-size: .9em; }
th button { all: unset; cursor: pointer; font: inherit; }
th button:hover, th button:focus-visible { color: var(--accent); }
th[aria-sort=ascending] button::after { content: " \\25b4"; color: var(--accent); }
th[aria-sort=descending] button::after { content: " \\25be"; color: var(--accent); }
.footnotes { color: var(--soft); margin: .6rem 0 0; padding-left: 1.1rem; }
.grid { display: grid; grid-template-columns: minmax(4.5rem, max-content) 1fr; gap: .3rem .8rem;
  min-width: calc(var(--columns) * 3.6rem + 5.5rem); max-width: calc(var(--columns) * 9rem + 9rem); }
.grid .heads { grid-column: 2; display: grid; grid-template-columns: repeat(var(--columns), 1fr); }
.grid .heads span { font-size: .74rem; line-height: 1.2; color: var(--soft); text-align: center; align-self: end;
  padding: 0 .15rem; overflow-wrap: anywhere; }
.grid .labels { display: grid; grid-template-rows: repeat(var(--rows), 1fr); max-width: 9rem; }
.grid .labels span { font-size: .85rem; line-height: 1.25; color: var(--soft); align-self: center; }
.grid img { display: block; width: 100%; height: auto; }
.clips { display: flex; flex-wrap: wrap; gap: 1rem 1.4rem; }
.clips figure { margin: 0; }
.clips figcaption { font-size: .85rem; line-height: 1.3; color: var(--soft); max-width: 24rem; margin-top: .25rem; }
.clips img { display: block; max-width: 100%; height: auto; }
svg { display: block; width: 100%; max-width: 660px; min-width: 430px; height: auto; color: var(--ink); }
svg text { font-family: inherit !important; }
.legend { display: flex; flex-wrap: wrap; gap: .2rem 1.3rem; margin: .4rem 0 0; padding: 0; list-style: none;
  font-size: .85rem; color: var(--soft); }
.legend i { display: inline-block; width: 1.5rem; margin-right: .45rem; vertical-align: middle; }
footer { margin-top: 3rem; padding-top: .8rem; border-top: 1px solid var(--line); font-size: .85rem; }
@media (max-width: 44rem) { .steps { grid-template-columns: 1fr 1fr; } }
@media (max-width: 34rem) {
  body { font-size: 15px; }
  main { padding: 1.3rem 1rem 3rem; }
  h1 { font-size: 1.4rem; }
  th, td { padding: .34rem .55rem; }
  .steps { gap: 1rem 1.9rem; }
  .steps .follows .picture::before { left: -1.9rem; width: 1.9rem; }
}
@media print { .scroll { overflow: visible; } section { break-inside: avoid; } nav { display: none; } }
"""

SCRIPT = """
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
const unfold = () => {
  const target = location.hash && document.getElementById(location.hash.slice(1));
  for (const folded of target ? target.querySelectorAll("details") : []) folded.open = true;
};
addEventListener("hashchange", unfold);
unfold();
"""
