"""What a body does around the moment it is labelled at: the condition of generators that record a moving body.

The generator is handed the motion; the picture beside it, a normal map of the labelled pose, is for looking at. What
the simulated camera sees besides (clothes, light, background) is drawn by the generator, from its own seed.

Source: ControlEvents (Hu et al., WACV 2026), the comparison with SMPL-ESIM, which simulates events from a sequence of
SMPL poses; the poses are those that the other generators get.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import Field

from ctlev_core.body.smpl_files import given_body_file
from ctlev_core.render.body_normals import render_labelled_normals
from data_contracts.config import RUN_SETTING, Frozen
from data_contracts.errors import DataError
from data_contracts.labels import BodyMotions, Conditions, Labels, check_body_motions

VERSION = 1
NEEDS = "motion"
WHERE = "condition 'body_motion'"
SAME_TOLERANCE = 1e-3
"""Shape coefficients of a label and of its motion differ by rounding at most."""


class Options(Frozen):
    """Options of the motion of a body."""

    prompt: str = Field(default="A moving human", description="The same prompt for every image, as in the paper.")
    body: Path | None = Field(
        default=None,
        json_schema_extra=RUN_SETTING,
        description="SMPL file (.pkl, .npz) of the labels' body; the bundled body when null",
    )
    workers: int | None = Field(
        default=None, ge=1, json_schema_extra=RUN_SETTING, description="threads; one a core when null"
    )


def input_files(options: Options) -> list[Path]:
    """The body file where one is given; its content enters the cache key.

    Raises:
        DataError: no such file.
    """
    return given_body_file(options.body, WHERE)


def render(
    labels: Labels, image_size: tuple[int, int], options: Options, seeds: Sequence[int], motions: BodyMotions
) -> Conditions:
    """Check the motions and render the labelled pose of each row; nothing is random, so `seeds` only has to fit.

    Args:
        labels: N rows with SMPL parameters in the camera frame, and the intrinsics of an image of `image_size`.
        image_size: (width, height) px.
        options: see `Options`.
        seeds: N integers, unused.
        motions: N motions of the same bodies; their intrinsics are those of the sensor, not of the image.
    Returns:
        N conditions with `motions` as they came, and images [N, H, W, 3] uint8: normal maps in ControlNet's colours.
    Raises:
        DataError: the labels have no SMPL parameters or no intrinsics, a motion is malformed or of a body of another
            shape, the numbers of rows differ, or the body file is wrong.
    """
    if not len(seeds) == len(motions) == len(labels):
        raise DataError(f"{WHERE}: {len(labels)} labels but {len(motions)} motions and {len(seeds)} seeds")
    check_body_motions(motions, WHERE)
    if labels.smpl_betas is not None:
        _check_same_bodies(labels.smpl_betas, motions.smpl_betas)
    images = render_labelled_normals(labels, image_size, WHERE, body_file=options.body, workers=options.workers)
    return Conditions((options.prompt,) * len(labels), images, motions)


def _check_same_bodies(labelled: np.ndarray, moving: np.ndarray) -> None:
    """Raise `DataError` unless the shape coefficients [N, 10] of labels and motions agree."""
    differs = ~np.isclose(moving, labelled, rtol=SAME_TOLERANCE, atol=SAME_TOLERANCE).all(axis=1)
    if differs.any():
        row = int(np.argmax(differs))
        raise DataError(
            f"{WHERE}: row {row} has smpl_betas {labelled[row].tolist()} in the label but "
            f"{moving[row].tolist()} in the motion"
        )
