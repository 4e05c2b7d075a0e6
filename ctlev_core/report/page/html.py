"""A report as one HTML file that needs nothing else: no network, no fonts, no scripts from elsewhere.

The caller gives sections in the order they are read; every text of theirs is escaped, and `backticks` become code.
"""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from urllib.parse import quote

import numpy as np

from ctlev_core.report.page import figures
from ctlev_core.report.page.style import SCRIPT, STYLE
from ctlev_core.report.page.tables import Table, format_table, split_number


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
    """

    title: str
    rows: Sequence[tuple[str, Sequence[np.ndarray]]]
    column_labels: Sequence[str] = ()
    caption: str = ""


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
class Links:
    """Pages beside this one: (text, relative address) of each."""

    title: str
    pages: Sequence[tuple[str, str]]


Section = Text | Table | ImageGrid | Curves | Animation | Links


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


def render_report(
    *,
    title: str,
    lead: str,
    verdict: str,
    sections: Sequence[Section | Folded],
    overview: Table | None = None,
    footer: str = "",
    steps: Sequence[Step] = (),
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
    Returns:
        One HTML document. Equal arguments give equal text.
    Raises:
        ValueError: rows of a table do not fit its columns, images are not images, or series differ in length.
    """
    entries = "".join(
        f'<li><a href="#section-{number}">{_inline(section.title)}</a></li>'
        for number, section in enumerate(sections, 1)
    )
    contents = f'<nav aria-label="Contents"><ol>{entries}</ol></nav>' if len(sections) > 2 else ""
    body = "\n".join(_numbered(section, number) for number, section in enumerate(sections, 1))
    numbers = "" if overview is None else f"{_table(overview)}\n"
    foot = f"<footer>{_paragraphs(footer)}</footer>" if footer else ""
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'">
<title>{html.escape(title)}</title>
<style>{STYLE}</style>
</head>
<body>
<main>
<header>
<h1>{_inline(title)}</h1>
<div class="lead">{_paragraphs(lead)}</div>
<div class="verdict">{_paragraphs(verdict)}</div>
{numbers}{_strip(steps)}{contents}
</header>
{body}
{foot}
</main>
<script>{SCRIPT}</script>
</body>
</html>
"""


def _numbered(section: Section | Folded, number: int) -> str:
    if not isinstance(section, Folded):
        return f'<section id="section-{number}"><h2>{_inline(section.title)}</h2>\n{_section(section)}</section>'
    parts = "\n".join(
        (f"<h3>{_inline(part.title)}</h3>\n" if len(section.sections) > 1 else "") + _section(part)
        for part in section.sections
    )
    return (
        f'<section id="section-{number}"><details><summary><h2>{_inline(section.title)}</h2></summary>\n'
        f"{_caption(section.caption)}{parts}</details></section>"
    )


def _strip(steps: Sequence[Step]) -> str:
    """Pictures with a heading and a sentence below each."""
    parts = []
    for step in steps:
        if isinstance(step.picture, str):
            picture = f'<p class="words">{_inline(step.picture)}</p>'
        else:
            png = base64.b64encode(figures.image_grid_png([[step.picture]], min_cell_px=192)).decode("ascii")
            picture = f'<img alt="{html.escape(step.heading)}" src="data:image/png;base64,{png}">'
        follows = ' class="follows"' if step.follows else ""
        parts.append(
            f'<li{follows}><figure><div class="picture">{picture}</div>'
            f"<figcaption><b>{_inline(step.heading)}</b> {_inline(step.sentence)}"
            "</figcaption></figure></li>"
        )
    return f'<ol class="steps">{"".join(parts)}</ol>\n' if parts else ""


def _section(section: Section) -> str:
    if isinstance(section, Text):
        return _paragraphs(section.text)
    if isinstance(section, Table):
        return _table(section)
    if isinstance(section, ImageGrid):
        return _image_grid(section)
    if isinstance(section, Animation):
        return _animation(section)
    if isinstance(section, Links):
        pages = (f'<li><a href="{html.escape(quote(place))}">{_inline(text)}</a></li>' for text, place in section.pages)
        return f"<ul>{''.join(pages)}</ul>"
    return _curves(section)


def _inline(text: str) -> str:
    """Escaped text in which `this` is code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(text))


def _paragraphs(text: str) -> str:
    parts = [part.strip() for part in re.split(r"\n\s*\n", text) if part.strip()]
    return "\n".join(f"<p>{_inline(part)}</p>" for part in parts)


def _caption(text: str) -> str:
    return f'<p class="caption">{_inline(text)}</p>\n' if text else ""


def _table(table: Table) -> str:
    shown = format_table(table)
    if not shown.rows:
        return _caption(table.caption) + '<p class="empty">No rows.</p>'
    head = "".join(
        f'<th scope="col"{_class("number" if is_number else "")}><button type="button">{_inline(name)}</button></th>'
        for name, is_number in zip(table.columns, shown.numeric, strict=True)
    )
    body = "\n".join(
        "<tr>" + "".join(_cell(text, shown.numeric[x], (y, x) in table.bold) for x, text in enumerate(row)) + "</tr>"
        for y, row in enumerate(shown.rows)
    )
    notes = "".join(f"<li>{_inline(note)}</li>" for note in table.footnotes)
    footnotes = f'<ul class="footnotes">{notes}</ul>' if notes else ""
    return (
        f"{_caption(table.caption)}"
        f'<div class="scroll" tabindex="0"><table>\n<thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody></table></div>"
        f"{footnotes}"
    )


def _class(names: str) -> str:
    return f' class="{names}"' if names else ""


def _cell(text: str, numeric: bool, bold: bool) -> str:
    names = " ".join(name for name, on in (("number", numeric), ("bold", bold)) if on)
    found = split_number(text) if numeric else None
    if found is None:
        return f"<td{_class(names)}>{_inline(text)}</td>"
    number, unit, uncertainty = found
    sort_key = number.replace(",", "").replace("−", "-")
    shown = html.escape(number + unit)
    if uncertainty:
        shown += f'<span class="uncertainty">{html.escape(uncertainty)}</span>'
    return f'<td{_class(names)} data-sort="{sort_key}">{shown}</td>'


def _image_grid(grid: ImageGrid) -> str:
    columns = max((len(images) for _, images in grid.rows), default=0)
    if columns == 0:
        return _caption(grid.caption) + '<p class="empty">No images.</p>'
    if grid.column_labels and len(grid.column_labels) != columns:
        raise ValueError(f"grid {grid.title!r}: {len(grid.column_labels)} column labels for {columns} columns")
    png = base64.b64encode(figures.image_grid_png([images for _, images in grid.rows])).decode("ascii")
    labels = "".join(f"<span>{_inline(label)}</span>" for label, _ in grid.rows)
    heads = "".join(f"<span>{_inline(label)}</span>" for label in grid.column_labels)
    description = html.escape(grid.title + ": " + "; ".join(label for label, _ in grid.rows))
    return (
        f"{_caption(grid.caption)}"
        f'<div class="scroll" tabindex="0"><div class="grid" style="--columns:{columns};--rows:{len(grid.rows)}">'
        f'<div class="heads">{heads}</div><div class="labels">{labels}</div>'
        f'<img alt="{description}" src="data:image/png;base64,{png}"></div></div>'
    )


def _animation(animation: Animation) -> str:
    if not animation.clips:
        return _caption(animation.caption) + '<p class="empty">No pictures.</p>'
    parts = []
    for label, frames in animation.clips:
        webp = base64.b64encode(figures.animation_webp(frames, animation.rate_hz)).decode("ascii")
        source = f'<img alt="{html.escape(label)}" src="data:image/webp;base64,{webp}">'
        parts.append(f"<figure>{source}<figcaption>{_inline(label)}</figcaption></figure>")
    return f'{_caption(animation.caption)}<div class="clips">{"".join(parts)}</div>'


def _curves(curves: Curves) -> str:
    if not any(len(x) for x, _ in curves.series.values()):
        return _caption(curves.caption) + '<p class="empty">No points.</p>'
    svg = figures.curves_svg(
        curves.series, curves.x_label, curves.y_label, log_x=curves.log_x, log_y=curves.log_y, spans=curves.spans
    )
    legend = "".join(
        f'<li><i style="border-top:2px {style} {colour}"></i>{_inline(name)}</li>'
        for name, (colour, style) in ((name, figures.series_style(index)) for index, name in enumerate(curves.series))
    )
    return f'{_caption(curves.caption)}<div class="scroll" tabindex="0">{svg}</div><ul class="legend">{legend}</ul>'
