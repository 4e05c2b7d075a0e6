"""A report as one HTML file that needs nothing else: no network, no fonts, no scripts from elsewhere.

The caller gives sections in the order they are read; every text of theirs is escaped, and `backticks` become code.
"""

from __future__ import annotations

import base64
import html
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeGuard

import numpy as np

from ctlev_core.report import figures
from ctlev_core.report.style import SCRIPT, STYLE

Cell = str | float | int | bool | None
NO_VALUE = "–"
# A number, then perhaps its uncertainty: "6.31", "-1,234", "5.0e-3", "6.31 ± 0.02", "6.313 [6.120, 6.500]", "93 %".
_NUMBER = re.compile(r"^([-+−]?[\d,]*\.?\d+(?:e[-+]?\d+)?)((?:\s*%)?)(\s*(?:±|\[|\().*)?$", re.IGNORECASE)


@dataclass(frozen=True)
class Text:
    """Paragraphs, separated by empty lines."""

    title: str
    text: str


@dataclass(frozen=True)
class Table:
    """A table the reader can sort by clicking a heading.

    Attributes:
        title: heading of the section.
        columns: column headings.
        rows: cells; numbers are formatted column by column, texts are shown as they are, None and NaN as a dash.
        caption: what the reader must know to read it.
        footnotes: one line each, below.
        bold: (row, column) of cells to emphasise.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""
    footnotes: Sequence[str] = ()
    bold: Collection[tuple[int, int]] = ()


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
    """

    title: str
    series: Mapping[str, tuple[Sequence[float], Sequence[float]]]
    x_label: str
    y_label: str
    log_x: bool = False
    log_y: bool = False
    caption: str = ""


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


Section = Text | Table | ImageGrid | Curves | Animation


def render_report(*, title: str, lead: str, verdict: str, sections: Sequence[Section], footer: str = "") -> str:
    """The page as text, to be written as UTF-8.

    Args:
        title: of the page.
        lead: first line: what data this is about, and what it must not be compared with.
        verdict: the answer, in a sentence or two.
        sections: in reading order; empty tables, grids and charts say so.
        footer: where the numbers come from.
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
    body = "\n".join(
        f'<section id="section-{number}"><h2>{_inline(section.title)}</h2>\n{_section(section)}</section>'
        for number, section in enumerate(sections, 1)
    )
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
{contents}
</header>
{body}
{foot}
</main>
<script>{SCRIPT}</script>
</body>
</html>
"""


def _section(section: Section) -> str:
    if isinstance(section, Text):
        return _paragraphs(section.text)
    if isinstance(section, Table):
        return _table(section)
    if isinstance(section, ImageGrid):
        return _image_grid(section)
    if isinstance(section, Animation):
        return _animation(section)
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
    for number, row in enumerate(table.rows):
        if len(row) != len(table.columns):
            raise ValueError(
                f"table {table.title!r}: row {number} has {len(row)} cells for {len(table.columns)} columns"
            )
    if not table.rows:
        return _caption(table.caption) + '<p class="empty">No rows.</p>'
    columns = [[row[index] for row in table.rows] for index in range(len(table.columns))]
    texts = [format_column(column) for column in columns]
    numeric = [all(_NUMBER.match(text) for text in column if text != NO_VALUE) for column in texts]
    head = "".join(
        f'<th scope="col"{_class("number" if is_number else "")}><button type="button">{_inline(name)}</button></th>'
        for name, is_number in zip(table.columns, numeric, strict=True)
    )
    body = "\n".join(
        "<tr>"
        + "".join(
            _cell(texts[index][row], numeric[index], (row, index) in table.bold) for index in range(len(table.columns))
        )
        + "</tr>"
        for row in range(len(table.rows))
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
    match = _NUMBER.match(text) if numeric else None
    if match is None:
        return f"<td{_class(names)}>{_inline(text)}</td>"
    number, unit, uncertainty = match.group(1), match.group(2), match.group(3) or ""
    sort_key = number.replace(",", "").replace("−", "-")
    shown = html.escape(number + unit)
    if uncertainty:
        shown += f'<span class="uncertainty">{html.escape(uncertainty)}</span>'
    return f'<td{_class(names)} data-sort="{sort_key}">{shown}</td>'


def format_column(cells: Sequence[Cell]) -> list[str]:
    """Texts of the cells of one column; fractions get the same number of decimals, enough for 4 significant digits."""
    decimals = 0
    for cell in cells:
        if _is_fraction(cell) and math.isfinite(cell):
            shortest = f"{float(cell):.4g}"
            decimals = max(decimals, len(shortest.partition(".")[2]) if "e" not in shortest else 0)
    return [_format(cell, decimals) for cell in cells]


def _is_fraction(cell: object) -> TypeGuard[float]:
    return isinstance(cell, float | np.floating)


def _format(cell: Cell, decimals: int) -> str:
    if cell is None or (_is_fraction(cell) and math.isnan(cell)):
        return NO_VALUE
    if isinstance(cell, bool | np.bool_):
        return "yes" if cell else "no"
    if isinstance(cell, int | np.integer):
        return f"{int(cell):,}"
    if not _is_fraction(cell):
        return str(cell) or NO_VALUE
    if math.isinf(cell):
        return "∞" if cell > 0 else "−∞"
    if cell and not 1e-4 <= abs(cell) < 1e9:
        return f"{float(cell):.3e}"
    return f"{float(cell):,.{decimals}f}"


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
    svg = figures.curves_svg(curves.series, curves.x_label, curves.y_label, log_x=curves.log_x, log_y=curves.log_y)
    legend = "".join(
        f'<li><i style="border-top:2px {style} {colour}"></i>{_inline(name)}</li>'
        for name, (colour, style) in ((name, figures.series_style(index)) for index, name in enumerate(curves.series))
    )
    return f'{_caption(curves.caption)}<div class="scroll" tabindex="0">{svg}</div><ul class="legend">{legend}</ul>'
