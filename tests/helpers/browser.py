"""Pages in a headless Chromium: what is wider than the window, what can hardly be read, what the console says."""

from __future__ import annotations

import contextlib
import functools
import html
import http.server
import json
import re
import shutil
import subprocess
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
WIDTHS = (390, 768, 1440)
"""px: a phone, a tablet, a desk."""
LEAST_CONTRAST = 4.5
"""Of text against what is behind it, 3 of large text: Web Content Accessibility Guidelines 2.1, 1.4.3, level AA."""

_AUDIT = """
const pages = PAGES, widths = WIDTHS, found = [];

// Colours as [red, green, blue, alpha] of 0 to 255 and 0 to 1, whatever notation the style has.
const canvas = document.createElement("canvas").getContext("2d", {willReadFrequently: true});
const rgba = (colour) => {
  canvas.clearRect(0, 0, 1, 1);
  canvas.fillStyle = colour;
  canvas.fillRect(0, 0, 1, 1);
  const [red, green, blue, alpha] = canvas.getImageData(0, 0, 1, 1).data;
  return [red, green, blue, alpha / 255];
};
const over = (above, below) => [0, 1, 2].map((i) => above[i] * above[3] + below[i] * (1 - above[3]));
const luminance = (colour) => {
  const [red, green, blue] = colour.map((value) => {
    const share = value / 255;
    return share <= 0.03928 ? share / 12.92 : ((share + 0.055) / 1.055) ** 2.4;
  });
  return 0.2126 * red + 0.7152 * green + 0.0722 * blue;
};
const contrast = (first, second) => {
  const [low, high] = [luminance(first), luminance(second)].sort((a, b) => a - b);
  return (high + 0.05) / (low + 0.05);
};

const audit = (view) => {
  const page = view.document, root = page.documentElement, low = [];
  // Opacity and picture backgrounds cannot be told from styles, and text over pictures is not judged.
  const background = (element) => {
    const layers = [];
    for (let at = element; at; at = at.parentElement) {
      const style = view.getComputedStyle(at);
      if (style.backgroundImage !== "none") return null;
      layers.push(rgba(style.backgroundColor));
      if (layers.at(-1)[3] === 1) break;
    }
    return layers.reverse().reduce((below, above) => over(above, below), [255, 255, 255]);
  };
  const texts = page.createTreeWalker(page.body, NodeFilter.SHOW_TEXT);
  while (texts.nextNode()) {
    const element = texts.currentNode.parentElement, text = texts.currentNode.textContent.trim();
    if (!text || !element.checkVisibility({opacityProperty: true, visibilityProperty: true})) continue;
    if (element.closest("script, style, title, [aria-hidden=true]")) continue;
    const style = view.getComputedStyle(element), behind = background(element);
    const ink = element instanceof view.SVGElement ? style.fill : style.color;
    if (behind === null || ink === "none") continue;
    const size = parseFloat(style.fontSize), large = size >= 24 || (size >= 18.66 && style.fontWeight >= 700);
    const ratio = contrast(over(rgba(ink), behind), behind);
    if (ratio < (large ? 3 : LEAST)) low.push(`${ratio.toFixed(2)}: ${text.slice(0, 40)}`);
  }
  const wide = root.scrollWidth > root.clientWidth ? widest(page, root.clientWidth) : "";
  return {wide, low: [...new Set(low)].slice(0, 8)};
};
const widest = (page, width) => {
  const found = [...page.querySelectorAll("body *")].filter((one) => one.getBoundingClientRect().right > width + 1);
  const last = found.at(-1);
  return last ? `${last.tagName}.${last.className} ${last.textContent.trim().slice(0, 40)}` : "the page";
};

(async () => {
  for (const name of pages) {
    for (const width of widths) {
      const frame = document.createElement("iframe");
      frame.style = `border: 0; width: ${width}px; height: 900px`;
      const loaded = new Promise((resolve) => frame.addEventListener("load", resolve));
      frame.src = name;
      document.body.append(frame);
      await loaded;
      for (const folded of frame.contentDocument.querySelectorAll("details")) folded.open = true;
      await new Promise((resolve) => setTimeout(resolve, 50));
      found.push({page: name, width, ...audit(frame.contentWindow)});
      frame.remove();
    }
  }
  document.querySelector("pre").textContent = JSON.stringify({found});
})();
"""


class _Quiet(http.server.SimpleHTTPRequestHandler):
    """Keeps its log to itself."""

    def log_message(self, format: str, *args: Any) -> None:
        pass


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    """The folder on a loopback port."""
    handler = functools.partial(_Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}"
        finally:
            server.shutdown()
            thread.join()


def run_in_browser(script: str, folder: Path, work: Path, *options: str) -> tuple[dict[str, Any], str]:
    """What a script leaves as JSON in the `pre` of a page beside those of the folder, and what the console said.

    Args:
        script: may look into frames of pages of the folder.
        folder: is served on loopback; `probe.html` is written there.
        work: for the browser's profile.
        options: of Chromium.
    """
    probe = f'<!DOCTYPE html><meta charset="utf-8"><body><pre></pre><script>{script}</script>'
    (folder / "probe.html").write_text(probe, encoding="utf-8")
    command = [
        str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--hide-scrollbars",
        f"--user-data-dir={work / 'profile'}", "--virtual-time-budget=60000", *options, "--dump-dom",
    ]  # fmt: skip
    # A page of the file system may not look into its frames; one of a server may.
    with served(folder) as url:
        finished = subprocess.run([*command, f"{url}/probe.html"], capture_output=True, text=True, timeout=240)
    (folder / "probe.html").unlink()
    found = re.search(r"<pre>(\{.*?\})</pre>", finished.stdout, re.DOTALL)
    assert found, finished.stderr[-2000:] + finished.stdout[-500:]
    return json.loads(html.unescape(found.group(1))), finished.stderr


def check_pages(folder: Path, pages: Sequence[str], work: Path) -> None:
    """Assert of pages of a folder, on a phone, a tablet and a desk, light and dark: nothing is wider than the window,
    all text can be read, and the console is silent. What is folded is unfolded first."""
    script = _AUDIT.replace("PAGES", json.dumps(list(pages))).replace("WIDTHS", json.dumps(WIDTHS))
    script = script.replace("LEAST", str(LEAST_CONTRAST))
    faults = []
    for scheme, number in (("light", 1), ("dark", 0)):
        found, console = run_in_browser(script, folder, work, f"--blink-settings=preferredColorScheme={number}")
        assert len(found["found"]) == len(pages) * len(WIDTHS)
        faults += [
            f"{view['page']} at {view['width']} px, {scheme}: {view['wide']} {view['low']}"
            for view in found["found"]
            if view["wide"] or view["low"]
        ]
        faults += [f"{scheme}: {line}" for line in re.findall("CONSOLE.*", console)]
    assert not faults, "\n".join(faults)
