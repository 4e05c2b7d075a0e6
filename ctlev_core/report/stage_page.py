"""What one stage made, as Markdown with its pictures inside: for pages that show text of others, as Prefect's does."""

from __future__ import annotations

import base64
import html

import numpy as np

from ctlev_core.events.windows import spread
from ctlev_core.report.page.charts import draw
from ctlev_core.report.page.display_names import metric_name, set_name
from ctlev_core.report.page.figures import image_grid_png
from ctlev_core.report.page.html import Curves
from ctlev_core.report.page.report_files import PAGE
from ctlev_core.report.page.tables import Table, markdown_table
from ctlev_core.report.sections.training_curves import loss_curves
from data_contracts.manifest import Manifest

NUM_IMAGES, NUM_COLUMNS = 12, 6
CELL_PX = 128
"""Images are enlarged by whole factors to at least this, larger ones reduced to it."""
MAX_ROWS = 40
_COLOURS = ("#2a6fbb", "#c8553d", "#4b8b3b")


def stage_page(made: Manifest, label: str) -> str:
    """What an artefact holds: some of its images, its loss curves, its scores, or where its page is.

    Args:
        made: the artefact.
        label: of the stage.
    """
    parts = [f"{len(made)} rows in `{made.ref.path}`."]
    page = made.ref.path / PAGE
    if page.is_file():
        parts.append(f"Report: [{page}]({page.as_uri()})")
    parts += _images(made, label) + _curves(made, label) + _scores(made)
    return "\n\n".join(parts) + "\n"


def _images(made: Manifest, label: str) -> list[str]:
    """A contact sheet of rows that are evenly spread."""
    name = next((name for name in ("frames", "images") if made.has_array(name)), None)
    if name is None or not len(made):
        return []
    array = made.array(name)
    if array.ndim != 4 or array.shape[-1] != 3 or array.dtype != np.uint8:
        return []
    shown = [_reduced(np.asarray(array[row])) for row in spread(len(array), NUM_IMAGES)]
    rows = [shown[start : start + NUM_COLUMNS] for start in range(0, len(shown), NUM_COLUMNS)]
    return [_picture(label, image_grid_png(rows, CELL_PX), "image/png")]


def _reduced(image: np.ndarray) -> np.ndarray:
    import cv2

    longer = max(image.shape[:2])
    if longer <= CELL_PX:
        return image
    size = (max(image.shape[1] * CELL_PX // longer, 1), max(image.shape[0] * CELL_PX // longer, 1))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _curves(made: Manifest, label: str) -> list[str]:
    if not {"curve", "step", "loss"} <= set(made.table.column_names):
        return []
    svg = curves_svg(loss_curves(label, [made], [label]))
    return [] if svg is None else [_picture(label, svg.encode(), "image/svg+xml")]


def curves_svg(curves: Curves) -> str | None:
    """A chart as a file of its own, on a white ground; None where there is no point."""
    drawn = draw(curves)
    if drawn is None:
        return None
    frame = drawn["frame"]
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{frame["width"]}" height="{frame["height"]}" '
        'font-family="sans-serif" font-size="12"><rect width="100%" height="100%" fill="white"/>'
    ]
    for place, text in drawn["x_ticks"]:
        lines.append(f'<text x="{place}" y="{frame["bottom"] + 16}" text-anchor="middle">{html.escape(text)}</text>')
    for place, text in drawn["y_ticks"]:
        lines.append(f'<path d="M{frame["left"]} {place}H{frame["right"]}" stroke="#ddd"/>')
        lines.append(
            f'<text x="{frame["left"] - 6}" y="{place}" dy=".35em" text-anchor="end">{html.escape(text)}</text>'
        )
    for number, (name, line) in enumerate(zip(curves.series, drawn["lines"], strict=True)):
        colour = _COLOURS[number % len(_COLOURS)]
        lines.append(f'<polyline points="{line["line"]}" fill="none" stroke="{colour}" stroke-width="1.5"/>')
        lines.append(
            f'<text x="{frame["right"] - 4}" y="{frame["top"] + 14 * (number + 1)}" text-anchor="end" '
            f'fill="{colour}">{html.escape(name)}</text>'
        )
    return "".join([*lines, "</svg>"])


def _scores(made: Manifest) -> list[str]:
    """Scores over all rows; of single classes there may be many."""
    if not {"subject", "metric", "value", "low", "high", "group"} <= set(made.table.column_names):
        return []
    rows = [row for row in made.table.to_pylist() if row["group"] == "all"][:MAX_ROWS]
    if not rows:
        return []
    cells = [
        [
            set_name(row["subject"]),
            metric_name(row["metric"]),
            row["value"],
            "" if row["low"] is None else f"[{row['low']:.3g}, {row['high']:.3g}]",
        ]
        for row in rows
    ]
    return [markdown_table(Table("Scores", ["of", "score", "value", "95 %"], cells))]


def _picture(label: str, content: bytes, kind: str) -> str:
    return f"![{label.replace(']', '')}](data:{kind};base64,{base64.b64encode(content).decode()})"
