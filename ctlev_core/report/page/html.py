"""A report as one HTML file that needs nothing else: no network, no fonts, no scripts from elsewhere.

The caller gives sections in the order they are read; every text of theirs is escaped, and `backticks` become code. How
the page looks is in `templates`.
"""

from __future__ import annotations

import base64
import functools
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from ctlev_core.report.page import charts, figures
from ctlev_core.report.page.report_files import FACTS
from ctlev_core.report.page.tables import Table, shown_cells

MIN_FILM_PX = 128
"""Films are enlarged by the smallest whole factor that makes their longer side at least this."""
Colours = Sequence[tuple[str, str]]
"""(CSS colour or gradient, meaning) of each entry of a legend."""


@dataclass(frozen=True)
class Text:
    """Paragraphs, separated by empty lines."""

    title: str
    text: str


@dataclass(frozen=True)
class ImageGrid:
    """Images in labelled rows.

    Attributes:
        title: heading of the section.
        rows: (label, images [H, W] or [H, W, 3] uint8) of each row.
        column_labels: one a column, or none.
        caption: what the reader sees.
        colours: legend.
    """

    title: str
    rows: Sequence[tuple[str, Sequence[np.ndarray]]]
    column_labels: Sequence[str] = ()
    caption: str = ""
    colours: Colours = ()


@dataclass(frozen=True)
class Curves:
    """Lines over a common axis.

    Attributes:
        title: heading of the section.
        series: name -> (x, y).
        x_label: with unit.
        y_label: with unit.
        log_x: logarithmic x axis.
        log_y: logarithmic y axis.
        caption: what the reader sees.
        spans: name -> (low, high), the ends of an interval at each x of that series; drawn as bars, NaN = none.
    """

    title: str
    series: Mapping[str, tuple[Sequence[float], Sequence[float]]]
    x_label: str
    y_label: str
    log_x: bool = False
    log_y: bool = False
    caption: str = ""
    spans: Mapping[str, tuple[Sequence[float], Sequence[float]]] = field(default_factory=dict)


@dataclass(frozen=True)
class Animation:
    """Moving pictures side by side, played for ever.

    Attributes:
        title: heading of the section.
        clips: (label, frames [T, H, W, 3] uint8) of each.
        rate_hz: frames a second.
        caption: what the reader sees.
    """

    title: str
    clips: Sequence[tuple[str, np.ndarray]]
    rate_hz: float
    caption: str = ""


@dataclass(frozen=True)
class Films:
    """Stretches of frames that play side by side for ever, drawn by the style sheet alone.

    Where a reader wants no motion, and on paper, the frames of each lie side by side.

    Attributes:
        title: heading of the section.
        rows: (label, clips) of each row; a clip is (label, frames [T, H, W, 3] uint8).
        rate_hz: frames a second.
        caption: what the reader sees.
        colours: legend.
    """

    title: str
    rows: Sequence[tuple[str, Sequence[tuple[str, np.ndarray]]]]
    rate_hz: float
    caption: str = ""
    colours: Colours = ()


@dataclass(frozen=True)
class Links:
    """Pages beside this one: (text, relative address) of each."""

    title: str
    pages: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Box:
    """A box of a diagram: place of its upper left corner, heading, a line below it, and where it leads."""

    x: float
    y: float
    heading: str
    line: str
    href: str


@dataclass(frozen=True)
class Diagram:
    """Boxes with arrows between them.

    Attributes:
        title: heading of the section.
        boxes: what is drawn.
        arrows: as paths of SVG.
        size: (width, height) of the drawing.
        box_size: of a box.
        caption: what the reader sees.
    """

    title: str
    boxes: Sequence[Box]
    arrows: Sequence[str]
    size: tuple[float, float]
    box_size: tuple[float, float]
    caption: str = ""


Section = Text | Table | ImageGrid | Curves | Animation | Films | Links | Diagram


@dataclass(frozen=True)
class Folded:
    """Sections that stay closed until the reader opens them.

    Attributes:
        title: what can be seen while it is closed.
        sections: shown one below the other, with headings of their own where there are several.
        caption: above them.
    """

    title: str
    sections: Sequence[Section]
    caption: str = ""


@dataclass(frozen=True)
class Chapter:
    """Sections that belong together, under one heading of the table of contents; none without sections."""

    title: str
    sections: Sequence[Section | Folded]


@dataclass(frozen=True)
class Step:
    """One picture of the strip that says what was done.

    Attributes:
        heading: two or three words.
        picture: [H, W] or [H, W, 3] uint8, or a text that stands in for one, such as a prompt.
        sentence: for a reader who knows nothing of events.
        follows: the step before leads to this one: an arrow stands between.
    """

    heading: str
    picture: np.ndarray | str
    sentence: str
    follows: bool = False


@dataclass(frozen=True)
class Answer:
    """Whether it helped, as a word and an interval on a line.

    Attributes:
        word: `Helped`, `Did harm`, `Undecided` ...
        tone: `good`, `bad` or `open`.
        text: the difference with its interval, and unit, as the score counts.
        value: the same with better being positive.
        low: lower end of the interval, likewise; NaN = unknown.
        high: upper end.
    """

    word: str
    tone: str
    text: str
    value: float
    low: float
    high: float

    def line(self) -> dict[str, float] | None:
        """Places from 0 (worse) to 100 (better) of zero, value and ends; None where the interval is not known."""
        known = np.array([self.low, self.value, self.high])
        reach = float(np.abs(known).max()) * 1.15
        if not np.isfinite(reach) or not reach:
            return None
        low, value, high = (round(50 + 50 * number / reach, 1) for number in known.tolist())
        return {"low": low, "value": value, "high": high}


def render_report(
    *,
    title: str,
    lead: str,
    verdict: str,
    sections: Sequence[Section | Folded | Chapter],
    overview: Table | None = None,
    footer: str = "",
    steps: Sequence[Step] = (),
    answer: Answer | None = None,
    plain: Sequence[tuple[str, str]] = (),
    details: Sequence[str] = (),
    colours: Colours = (),
) -> str:
    """The page as text, to be written as UTF-8.

    Args:
        title: of the page.
        lead: first line: what data this is about, and what it must not be compared with.
        verdict: the answer, in a sentence or two.
        sections: in reading order; empty tables, grids and charts say so.
        overview: the numbers behind the verdict, right below it.
        footer: where the numbers come from.
        steps: what was done, in pictures; below the verdict.
        answer: the verdict as a word and a drawn interval.
        plain: what was done and what it means, (heading, paragraph) each, for a reader who knows nothing of events.
        details: further sentences on the numbers, closed until the reader opens them.
        colours: legend of the pictures of `steps`.
    Returns:
        One HTML document. Equal arguments give equal text.
    Raises:
        ValueError: rows of a table do not fit its columns, images are not images, or series differ in length.
    """
    chapters: list[Chapter] = []
    for section in sections:
        if isinstance(section, Chapter):
            chapters += [section] if section.sections else []
        elif chapters and not chapters[-1].title:
            chapters[-1] = Chapter("", [*chapters[-1].sections, section])
        else:
            chapters.append(Chapter("", [section]))
    given = {
        "title": title, "lead": lead, "verdict": verdict, "overview": overview, "footer": footer, "steps": steps,
        "answer": answer, "plain": plain, "details": details, "colours": colours,
        "chapters": chapters, "facts": Markup(FACTS),
    }  # fmt: skip
    return _templates().get_template("page.html.j2").render(given)


@functools.cache
def _templates() -> Environment:
    loader = FileSystemLoader(Path(__file__).parent / "templates")
    found = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        keep_trailing_newline=True,
    )  # fmt: skip
    filters = (
        _inline, _paragraphs, _grid_png, _webp, _film, _code_of, shown_cells, charts.draw, charts.series_class, quote,
    )  # fmt: skip
    found.filters |= {one.__name__.lstrip("_"): one for one in filters}
    found.tests["picture"] = lambda value: isinstance(value, np.ndarray)
    return found


def _inline(text: str) -> Markup:
    """Escaped text in which `this` is code."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(str(text)))))


def _paragraphs(text: str) -> list[str]:
    return [part.strip() for part in re.split(r"\n\s*\n", text) if part.strip()]


def _code_of(text: str) -> str:
    """What a name that was put into words is called in tables and options; empty for other texts."""
    return getattr(text, "code", "")


def _grid_png(grid: ImageGrid | np.ndarray, min_cell_px: int = 128) -> str:
    """The pictures of a grid, or a single one, as a data address."""
    if isinstance(grid, np.ndarray):
        rows: list[Sequence[np.ndarray]] = [[grid]]
    else:
        rows, columns = [images for _, images in grid.rows], max(len(images) for _, images in grid.rows)
        if grid.column_labels and len(grid.column_labels) != columns:
            raise ValueError(f"grid {grid.title!r}: {len(grid.column_labels)} column labels for {columns} columns")
    png = figures.image_grid_png(rows, min_cell_px=min_cell_px)
    return f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}"


def _webp(frames: np.ndarray, rate_hz: float) -> str:
    webp = figures.animation_webp(frames, rate_hz)
    return f"data:image/webp;base64,{base64.b64encode(webp).decode('ascii')}"


def _film(frames: np.ndarray, rate_hz: float) -> dict[str, Any]:
    """What the template needs of a clip: the strip as a data address, how many frames, their size, and the seconds."""
    if not 0 < rate_hz < math.inf:
        raise ValueError(f"rate_hz must be positive, got {rate_hz}")
    strip = figures.film_strip(frames)
    png = base64.b64encode(figures.image_png(strip)).decode("ascii")
    width, height = strip.shape[1] // len(frames), strip.shape[0]
    factor = max(1, math.ceil(MIN_FILM_PX / max(width, height)))
    return {
        "source": f"data:image/png;base64,{png}",
        "count": len(frames),
        "width": width * factor,
        "height": height * factor,
        "seconds": round(len(frames) / rate_hz, 3),
    }
