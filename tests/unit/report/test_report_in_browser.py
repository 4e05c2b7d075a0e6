"""The report in a real browser: nothing is wider than a phone, tables sort, links unfold, and the console is
silent."""

import re

import numpy as np
import pytest
from browser import CHROMIUM, check_pages, run_in_browser
from report_artefacts import Experiment

from ctlev_core.report.page.html import ImageGrid, render_report
from tasks.report import report
from tasks.stage import Output

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")

PROBE = """
const results = {};
const shown = (table, column) => [...table.tBodies[0].rows].map(row => row.cells[column].textContent);
const sorted = (table, column) => {
  table.tHead.rows[0].cells[column].querySelector("button").click();
  return shown(table, column);
};
for (const [name, width] of [["phone", 360], ["desk", 1280]]) {
  const frame = document.createElement("iframe");
  frame.style = `border: 0; width: ${width}px; height: 800px`;
  frame.src = "report.html";
  frame.addEventListener("load", () => {
    const inner = frame.contentDocument, root = inner.documentElement, table = inner.querySelector("table");
    for (const folded of inner.querySelectorAll("details")) folded.open = true;
    const wide = [...inner.querySelectorAll(".scroll")].filter(box => box.scrollWidth > box.clientWidth).length;
    const found = {width: root.clientWidth, needed: root.scrollWidth, wide, before: shown(table, 1)};
    [found.ascending, found.descending] = [sorted(table, 1), sorted(table, 1)];
    for (const folded of inner.querySelectorAll("details")) folded.open = false;
    const style = frame.contentWindow.getComputedStyle(inner.body), last = inner.querySelector("section:last-of-type");
    [found.ink, found.paper] = [style.color, style.backgroundColor];
    frame.contentWindow.addEventListener("hashchange", () => {
      found.unfolded = last.querySelector("details").open;
      results[name] = found;
      document.querySelector("pre").textContent = JSON.stringify(results);
    });
    inner.querySelector(`a[href="#${last.id}"]`).click();
  });
  document.body.append(frame);
}
"""


def in_browser(page: str, folder, *options: str) -> tuple[dict, str]:
    """What the probe measured in frames of the width of a phone and of a desk, and what the console said."""
    (folder / "report.html").write_text(page, encoding="utf-8")
    return run_in_browser(PROBE, folder, folder, *options)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    experiment = Experiment(tmp_path_factory.mktemp("home"))
    folder = experiment.home / "made"
    folder.mkdir()
    report.function(Output(folder, folder), experiment.inputs, experiment.sequences)
    return (folder / "report.html").read_text()


def test_the_page_fits_a_phone_sorts_unfolds_and_says_nothing_to_the_console(page, tmp_path):
    found, console = in_browser(page, tmp_path)
    assert set(found) == {"phone", "desk"}
    for name, width in (("phone", 360), ("desk", 1280)):
        view = found[name]
        assert view["needed"] <= view["width"] <= width
        numbers = [float(text.split()[0]) for text in view["before"]]
        assert [float(text.split()[0]) for text in view["ascending"]] == sorted(numbers)
        assert [float(text.split()[0]) for text in view["descending"]] == sorted(numbers, reverse=True)
        assert numbers != sorted(numbers) and view["unfolded"]
    assert found["phone"]["wide"] > found["desk"]["wide"]
    assert "CONSOLE" not in console, re.findall("CONSOLE.*", console)


def test_dark_mode_turns_ink_and_page_round(page, tmp_path):
    def brightness(colour: str) -> float:
        return sum(int(number) for number in re.findall(r"\d+", colour)[:3]) / 3

    light, _ = in_browser(page, tmp_path, "--blink-settings=preferredColorScheme=1")
    dark, _ = in_browser(page, tmp_path, "--blink-settings=preferredColorScheme=0")
    assert brightness(light["desk"]["paper"]) > 200 > 100 > brightness(light["desk"]["ink"])
    assert brightness(dark["desk"]["paper"]) < 60 < 180 < brightness(dark["desk"]["ink"])


def test_every_text_can_be_read_at_every_width_and_nothing_is_too_wide(page, tmp_path):
    (tmp_path / "report.html").write_text(page, encoding="utf-8")
    check_pages(tmp_path, ["report.html"], tmp_path)


GRID_PROBE = """
const frame = document.createElement("iframe");
frame.style = "border: 0; width: 1280px; height: 800px";
frame.src = "page.html";
frame.addEventListener("load", () => {
  const page = frame.contentDocument, picture = page.querySelector(".grid img").getBoundingClientRect();
  const place = ({left, right, top, bottom}) => [left, right, top, bottom].map(Math.round);
  const text = (span) => {
    const range = page.createRange();
    range.selectNodeContents(span);
    return Math.round(range.getBoundingClientRect().right);
  };
  const labels = [...page.querySelectorAll(".labels span")];
  document.querySelector("pre").textContent = JSON.stringify({
    picture: place(picture), labels: labels.map((span) => [...place(span.getBoundingClientRect()), text(span)]),
  });
});
document.body.append(frame);
"""


def test_labels_of_any_length_stay_beside_their_row_of_pictures(tmp_path):
    names = ["run", "walking_with_long_steps_and_turning_round", "x" * 500, "words " * 200, "jump"]
    grid = ImageGrid("Conditions", [(name, [np.zeros((12, 12), np.uint8)] * 10) for name in names])
    page = render_report(title="t", lead="l", verdict="v", sections=[grid])
    (tmp_path / "page.html").write_text(page, encoding="utf-8")
    found, _ = run_in_browser(GRID_PROBE, tmp_path, tmp_path)
    left, _, top, bottom = found["picture"]
    height = (bottom - top) / len(names)
    for row, (_, right, above, below, text_right) in enumerate(found["labels"]):
        assert text_right <= right <= left
        assert top + row * height - 3 <= above <= below <= top + (row + 1) * height + 3


def test_pale_text_wide_boxes_and_messages_are_found(tmp_path):
    (tmp_path / "page.html").write_text(
        '<!DOCTYPE html><body style="margin:0"><p style="color:#999">pale</p><p style="color:#767676">dark enough</p>'
        '<p style="color:#999;font-size:24px">3:1 is enough here: no</p>'
        '<p style="color:#949494;font-size:24px">large</p>'
        '<details><summary>more</summary><div style="width:800px">box</div></details>'
        '<svg width="90" height="20"><text y="15" fill="#ddd">drawn</text></svg><script>console.log("hello")</script>',
        encoding="utf-8",
    )
    with pytest.raises(AssertionError) as told:
        check_pages(tmp_path, ["page.html"], tmp_path)
    text = str(told.value)
    assert "page.html at 390 px, light: DIV. box" in text and "page.html at 1440 px, light:  [" in text
    assert all(word in text for word in ("2.85: pale", "drawn", "hello", "3:1 is enough here: no"))
    assert "dark enough" not in text and "large" not in text
