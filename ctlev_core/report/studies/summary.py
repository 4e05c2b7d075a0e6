"""What a page of several experiments shows of each: its verdict, what was done in pictures, samples and figures.

A report keeps its summary as JSON beside its page, pictures as PNG, so that the page over several is made from their
reports alone.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ctlev_core.report.page.html import Animation, Colours, Curves, ImageGrid, Step
from data_contracts.errors import DataError

SUMMARY_FILE = "summary.json"
Figure = Curves | Animation


@dataclass(frozen=True, eq=False)
class Summary:
    """See the module's docstring.

    Attributes:
        verdict: a paragraph.
        steps: what was done.
        grid: what was asked for, and sampled.
        figures: how scores change with the amounts of data and training, and frames in motion.
        colours: legend of the pictures.
    """

    verdict: str
    steps: list[Step]
    grid: ImageGrid
    figures: Sequence[Figure] = ()
    colours: Colours = ()


def write_summary(folder: Path, summary: Summary) -> None:
    """Write `summary.json`."""
    grid, steps = summary.grid, summary.steps
    content = {
        "verdict": summary.verdict,
        "steps": [{**vars(step), "picture": _picture(step.picture)} for step in steps],
        "grid": {**vars(grid), "rows": [[label, [_picture(image) for image in images]] for label, images in grid.rows]},
        "figures": [_stored(figure) for figure in summary.figures],
        "colours": list(summary.colours),
    }
    (folder / SUMMARY_FILE).write_text(json.dumps(content), encoding="utf-8")


def read_summary(folder: Path) -> Summary:
    """Read `summary.json`.

    Raises:
        DataError: it is missing or damaged.
    """
    path = folder / SUMMARY_FILE
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        steps = [Step(**{**step, "picture": _opened(step["picture"])}) for step in content["steps"]]
        rows = [(label, [_image(image) for image in images]) for label, images in content["grid"]["rows"]]
        grid = ImageGrid(**{**content["grid"], "rows": rows})
        figures = [_figure(stored) for stored in content["figures"]]
        return Summary(content["verdict"], steps, grid, figures, content["colours"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path}: is not the summary of a report: {error}") from error


def _stored(figure: Figure) -> dict[str, Any]:
    if isinstance(figure, Curves):
        return vars(figure)
    return {**vars(figure), "clips": [[label, [_picture(image) for image in clip]] for label, clip in figure.clips]}


def _figure(stored: dict[str, Any]) -> Figure:
    if "clips" not in stored:
        return Curves(**stored)
    clips = [(label, np.stack([_image(image) for image in images])) for label, images in stored["clips"]]
    return Animation(**{**stored, "clips": clips})


def _picture(picture: np.ndarray | str) -> Any:
    if isinstance(picture, str):
        return picture
    pixels = picture if picture.ndim == 2 else picture[..., ::-1]
    _, png = cv2.imencode(".png", np.ascontiguousarray(pixels))
    return {"png": base64.b64encode(png.tobytes()).decode("ascii")}


def _opened(stored: Any) -> np.ndarray | str:
    return stored if isinstance(stored, str) else _image(stored)


def _image(stored: dict[str, str]) -> np.ndarray:
    pixels = cv2.imdecode(np.frombuffer(base64.b64decode(stored["png"]), np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ValueError("a picture in it is no PNG")
    return np.ascontiguousarray(pixels if pixels.ndim == 2 else pixels[..., ::-1])
