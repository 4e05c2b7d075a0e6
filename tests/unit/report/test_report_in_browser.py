"""The report in a real browser: nothing is wider than a phone, tables sort, links unfold, and the console is
silent."""

import contextlib
import functools
import html
import http.server
import json
import re
import shutil
import subprocess
import threading

import pytest
from report_artefacts import Experiment

from tasks.report import report
from tasks.stage import Output

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
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


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Keeps its log to itself."""

    def log_message(self, format, *args):
        pass


@contextlib.contextmanager
def served(folder):
    """The folder on a loopback port."""
    handler = functools.partial(Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}"
        finally:
            server.shutdown()
            thread.join()


def in_browser(page: str, folder, *options: str) -> tuple[dict, str]:
    """What the probe measured in frames of the width of a phone and of a desk, and what the console said."""
    (folder / "report.html").write_text(page, encoding="utf-8")
    probe = f'<!DOCTYPE html><meta charset="utf-8"><body><pre></pre><script>{PROBE}</script>'
    (folder / "probe.html").write_text(probe, encoding="utf-8")
    command = [
        str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--hide-scrollbars",
        f"--user-data-dir={folder / 'profile'}", "--virtual-time-budget=20000", *options, "--dump-dom",
    ]  # fmt: skip
    # A page of the file system may not look into its frames; one of a server may.
    with served(folder) as url:
        finished = subprocess.run([*command, f"{url}/probe.html"], capture_output=True, text=True, timeout=240)
    found = re.search(r"<pre>(\{.*?\})</pre>", finished.stdout, re.DOTALL)
    assert found, finished.stderr[-2000:] + finished.stdout[-500:]
    return json.loads(html.unescape(found.group(1))), finished.stderr


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    experiment = Experiment(tmp_path_factory.mktemp("home"))
    folder = experiment.home / "made"
    folder.mkdir()
    report.function(Output(folder, folder), experiment.inputs)
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
