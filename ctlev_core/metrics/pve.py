"""Mean per-vertex error of a body, mm: as predicted, from the pelvis, or up to a similarity.

Source: PVE of the paper's Table 3, whose alignment it does not name. Event-HPE's code (Zou et al., ICCV 2021,
`loss_funcs.py`) computes what it calls PVE after a similarity, that is PA-PVE. The three are always given together.
The vertices are those of the body of `body`, for predictions and labels alike, and not a label's own mesh.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, field_serializer

from ctlev_core.scoring.mesh import compute_vertex_errors_mm
from ctlev_core.scoring.pose import Alignment, Sums, quotients
from ctlev_core.scoring.score_info import ScoreInfo
from data_contracts.config import Frozen
from data_contracts.errors import DataError
from data_contracts.labels import Labels
from data_contracts.remembered_files import remembered_digest

VERSION = 1
INPUT = "smpl"
SCORES = (
    ScoreInfo(
        "pve",
        lower_is_better=True,
        meaning="mean distance between predicted and true points of the body's surface, in millimetres",
    ),
)
NAMES: dict[Alignment, str] = {"pelvis": "pve_pelvis_mm", "procrustes": "pve_pa_mm", "none": "pve_mm"}


class Options(Frozen):
    """The body, and which of the three is compared row by row."""

    body: str = Field(default="", description="SMPL file (.pkl or .npz) of the body; empty = the bundled one")
    alignment: Alignment = Field(
        default="pelvis", description="the one that comes first and that models are compared by"
    )

    @field_serializer("body", when_used="json")
    def _content_of_body(self, body: str) -> str:
        """What keys and records know of the file: its SHA-256, for another body makes other scores of the same name."""
        return remembered_digest(Path(body)) if body else ""


def input_files(options: Options) -> list[Path]:
    """The SMPL file, if one is named.

    Raises:
        DataError: it is missing.
    """
    file = _body_file(options)
    if file is not None and not file.is_file():
        raise DataError(f"pve: expected option `body` to be an SMPL file (.pkl or .npz), got {file}")
    return [] if file is None else [file]


def compute(predicted: Mapping[str, Any], target: Labels, options: Options) -> dict[str, float]:
    """`pve_pelvis_mm`, `pve_pa_mm` and `pve_mm`, the chosen one first.

    Args:
        predicted: `smpl_pose` [N, 72] rad, `smpl_betas` [N, 10] and `smpl_transl` [N, 3] m, camera frame.
        target: labels with the same parameters in the same frame.
        options: the body, and which comes first.
    Raises:
        ValueError: there is no row; see also `compute_vertex_errors_mm`.
    """
    if not len(target):
        raise ValueError("there is no row to score")
    return quotients(compute_sums(predicted, target, options))


def compute_sums(predicted: Mapping[str, Any], target: Labels, options: Options) -> Sums:
    """Of each row its error [N] mm, and ones [N]: every body has the same number of vertices."""
    order = sorted(NAMES, key=lambda alignment: alignment != options.alignment)
    errors_mm = compute_vertex_errors_mm(predicted, target, _body_file(options), order)
    return {NAMES[alignment]: (errors, np.ones(len(errors))) for alignment, errors in errors_mm.items()}


def compute_rows(predicted: Mapping[str, Any], target: Labels, options: Options) -> np.ndarray:
    """Error [N] mm of each row in the chosen alignment."""
    errors_mm = compute_vertex_errors_mm(predicted, target, _body_file(options), [options.alignment])
    return errors_mm[options.alignment]


def _body_file(options: Options) -> Path | None:
    return Path(options.body) if options.body else None
