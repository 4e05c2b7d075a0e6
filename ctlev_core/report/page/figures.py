"""Pictures of the report: grids of images as PNG, curves as SVG."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

SERIES_COLOURS = ("#3b7dd8", "#e07b39", "#3a9d6e", "#c2528b", "#8a6fd1", "#b8922f", "#4fa3b5", "#808080")
"""Distinct from one another for most colour-blind readers, and legible on white and on near-black."""
LINE_STYLES = ("solid", "dashed", "dotted")
"""Taken in turn once all colours are used up."""

_INK = "#010203"
"""Stands for the text colour of the page, which an SVG inside a page can inherit."""
_MARKED_POINTS = 24
"""Series with fewer points than this show each of them."""


def image_grid_png(rows: Sequence[Sequence[np.ndarray]], min_cell_px: int = 128, gap_px: int = 4) -> bytes:
    """All images of a grid as one PNG, enlarged without smoothing, on a transparent ground.

    Args:
        rows: images [H, W] or [H, W, 3] uint8, row by row; a short row leaves its last cells empty. Images
            smaller than the largest one are enlarged to it and centred.
        min_cell_px: cells are enlarged by the smallest whole factor that makes their longer side at least this.
        gap_px: transparent px between two cells.
    Returns:
        The PNG file.
    Raises:
        ValueError: there is no image, or one has another shape or dtype.
    """
    import cv2

    images = [[_to_rgb(image) for image in row] for row in rows]
    shapes = [image.shape for row in images for image in row]
    if not shapes:
        raise ValueError("a grid needs at least one image, got none")
    height, width = max(shape[0] for shape in shapes), max(shape[1] for shape in shapes)
    factor = max(1, math.ceil(min_cell_px / max(height, width)))
    height, width = height * factor, width * factor
    columns = max(len(row) for row in images)
    canvas = np.zeros((len(rows) * (height + gap_px) - gap_px, columns * (width + gap_px) - gap_px, 4), dtype=np.uint8)
    for y, row in enumerate(images):
        for x, image in enumerate(row):
            top, left = y * (height + gap_px), x * (width + gap_px)
            cell = canvas[top : top + height, left : left + width]
            cell[..., 3] = 255
            _paste_enlarged(image, cell[..., :3])
    encoded, data = cv2.imencode(".png", cv2.cvtColor(canvas, cv2.COLOR_RGBA2BGRA))
    if not encoded:
        raise ValueError(f"a grid of {canvas.shape[1]} x {canvas.shape[0]} px does not fit into a PNG")
    return data.tobytes()


def animation_webp(frames: np.ndarray, rate_hz: float, min_side_px: int = 192) -> bytes:
    """An endless animation, enlarged without smoothing.

    Args:
        frames: [T, H, W, 3] uint8 RGB.
        rate_hz: frames a second; viewers round times to milliseconds.
        min_side_px: frames are enlarged by the smallest whole factor that makes their shorter side at least this.
    Returns:
        The WebP file.
    Raises:
        ValueError: no frames, another shape or dtype, or a rate that is not positive.
    """
    import cv2

    if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8 or 0 in frames.shape:
        raise ValueError(f"frames must be [T, H, W, 3] uint8 with something in them, got {frames.shape} {frames.dtype}")
    if not 0 < rate_hz < math.inf:
        raise ValueError(f"rate_hz must be positive, got {rate_hz}")
    factor = max(1, math.ceil(min_side_px / min(frames.shape[1:3])))
    animation = cv2.Animation()
    animation.frames = [
        cv2.cvtColor(frame.repeat(factor, axis=0).repeat(factor, axis=1), cv2.COLOR_RGB2BGRA) for frame in frames
    ]
    animation.durations = [max(1, round(1000 / rate_hz))] * len(frames)
    # A quality above 100 is lossless.
    encoded, data = cv2.imencodeanimation(".webp", animation, [cv2.IMWRITE_WEBP_QUALITY, 101])
    if not encoded:
        raise ValueError(f"{len(frames)} frames of {frames.shape[2]} x {frames.shape[1]} px do not fit into a WebP")
    return data.tobytes()


def _to_rgb(image: np.ndarray) -> np.ndarray:
    image = np.asarray(image)
    is_grey, is_rgb = image.ndim == 2, image.ndim == 3 and image.shape[-1] == 3
    if not (is_grey or is_rgb) or image.dtype != np.uint8 or image.size == 0:
        raise ValueError(f"an image must be [H, W] or [H, W, 3] uint8, got {image.shape} {image.dtype}")
    return np.repeat(image[..., None], 3, axis=-1) if is_grey else image


def _paste_enlarged(image: np.ndarray, cell: np.ndarray) -> None:
    """Nearest-neighbour copy of `image` into the middle of `cell`, as large as its proportions allow."""
    scale = min(cell.shape[0] / image.shape[0], cell.shape[1] / image.shape[1])
    height, width = (max(1, math.floor(size * scale)) for size in image.shape[:2])
    rows = np.arange(height) * image.shape[0] // height
    columns = np.arange(width) * image.shape[1] // width
    top, left = (cell.shape[0] - height) // 2, (cell.shape[1] - width) // 2
    cell[top : top + height, left : left + width] = image[rows[:, None], columns]


def series_style(index: int) -> tuple[str, str]:
    """Colour and line style of the series with this number."""
    turn, colour = divmod(index, len(SERIES_COLOURS))
    return SERIES_COLOURS[colour], LINE_STYLES[turn % len(LINE_STYLES)]


def curves_svg(
    series: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    x_label: str,
    y_label: str,
    *,
    log_x: bool = False,
    log_y: bool = False,
    spans: Mapping[str, tuple[Sequence[float], Sequence[float]]] | None = None,
) -> str:
    """Line chart as an `<svg>` element whose text and axes take the colour of the page around it.

    Args:
        series: name -> (x, y); points that are not finite, or not positive on a logarithmic axis, are left out. Names
            are not drawn: the page shows them in a legend, in the order and style of `series_style`.
        x_label: below the chart, unit included.
        y_label: left of it.
        log_x: logarithmic x axis.
        log_y: logarithmic y axis.
        spans: name -> (low, high) at each x of that series, drawn as a bar; none where an end is not finite.
    Returns:
        The element, without references to anything outside. Equal arguments give equal text.
    Raises:
        ValueError: x and y of a series differ in length.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    inked = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color")
    settings: dict[Any, Any] = {
        **dict.fromkeys(inked, _INK),
        "svg.fonttype": "none",
        "svg.hashsalt": "ctlev",
        "font.size": 9,
        "text.parse_math": False,
    }
    with rc_context(settings):
        figure = Figure(figsize=(6.4, 3.2), layout="constrained")
        axes = figure.add_subplot()
        for index, (name, (x, y)) in enumerate(series.items()):
            x, y = _drawable(name, x, y, log_x, log_y)
            colour, style = series_style(index)
            marker = "o" if len(x) < _MARKED_POINTS else None
            axes.plot(x, y, color=colour, linestyle=style, linewidth=1.4, marker=marker, markersize=3)
            if spans and name in spans:
                places, low, high = (np.asarray(v, np.float64) for v in (series[name][0], *spans[name]))
                known = np.isfinite(places + low + high)
                axes.vlines(places[known], low[known], high[known], color=colour, linewidth=1.1, alpha=0.6)
        axes.set(
            xlabel=x_label, ylabel=y_label, xscale="log" if log_x else "linear", yscale="log" if log_y else "linear"
        )
        for axis, logarithmic in ((axes.xaxis, log_x), (axes.yaxis, log_y)):
            if logarithmic:
                # Plain numbers at 1, 2 and 5 of each decade: matplotlib's own labels are formulas, and few.
                axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
                axis.set_major_formatter(StrMethodFormatter("{x:g}"))
                axis.set_minor_formatter(NullFormatter())
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.18, linewidth=0.6, color=_INK)
        file = io.StringIO()
        figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
    svg = file.getvalue()
    svg = svg[svg.index("<svg") :].strip().replace(_INK, "currentColor")
    # Descriptions and a style sheet of matplotlib's: the first are noise, the second would apply to the whole page.
    svg = re.sub(r"<(metadata|style)\b.*?</\1>", "", svg, flags=re.DOTALL)
    # Several charts share a page, where these ids, which nothing refers to, would be doubles.
    svg = re.sub(r'<g id="[^"]*">', "<g>", svg)
    return re.sub(r'<svg [^>]*?(viewBox="[^"]*")[^>]*>', r'<svg \1 role="img">', svg, count=1, flags=re.DOTALL)


def _drawable(
    name: str, x: Sequence[float], y: Sequence[float], log_x: bool, log_y: bool
) -> tuple[np.ndarray, np.ndarray]:
    x_values, y_values = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if x_values.shape != y_values.shape or x_values.ndim != 1:
        raise ValueError(
            f"series {name!r}: x and y must have the same length, got {x_values.shape} and {y_values.shape}"
        )
    keep = np.isfinite(x_values) & np.isfinite(y_values)
    if log_x:
        keep &= x_values > 0
    if log_y:
        keep &= y_values > 0
    return x_values[keep], y_values[keep]
