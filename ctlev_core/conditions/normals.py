"""3D bodies: a picture of the surface normals of the SMPL body, and one fixed prompt.

Source: ControlEvents, the human-body experiments: SMPL as normal maps for the "normal" ControlNet v1.0. The body is the
bundled procedural one unless a licensed SMPL file is given; no light, colour or background is rendered.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from ctlev_core.body.smpl_files import given_body_file
from ctlev_core.render.body_normals import render_labelled_normals
from data_contracts.config import RUN_SETTING, Frozen
from data_contracts.errors import DataError
from data_contracts.labels import Conditions, Labels

VERSION = 1
NEEDS = ""


class Options(Frozen):
    """Options of the normal map."""

    prompt: str = Field(default="A moving human", description="The same prompt for every image, as in the paper.")
    convention: Literal["controlnet", "controlnet_unreversed", "rgb"] = Field(
        default="controlnet",
        description="which axis is which colour: as ControlNet v1.0 sees it, red for near and blue for left; the same "
        "in the order of v1.0's annotator, for a ControlNet whose config says `bgr` and reverses it itself; or right, "
        "up, near as red, green, blue",
    )
    body: Path | None = Field(
        default=None,
        json_schema_extra=RUN_SETTING,
        description="SMPL file (.pkl, .npz) of the labels' body; the bundled body when null",
    )
    renderer: Literal["numba", "pyrender"] = Field(
        default="numba", description="rasteriser on the CPU, or OpenGL through EGL or OSMesa"
    )
    workers: int | None = Field(
        default=None, ge=1, json_schema_extra=RUN_SETTING, description="threads; one a core when null"
    )


def input_files(options: Options) -> list[Path]:
    """The body file where one is given; its content enters the cache key.

    Raises:
        DataError: no such file.
    """
    return given_body_file(options.body, "condition 'normals'")


def render(labels: Labels, image_size: tuple[int, int], options: Options, seeds: Sequence[int]) -> Conditions:
    """Render the body of each row; nothing is random, so `seeds` only has to fit.

    Args:
        labels: N rows with SMPL parameters in the camera frame, and the intrinsics of an image of `image_size`.
        image_size: (width, height) px.
        options: see `Options`.
        seeds: N integers, unused.
    Returns:
        N conditions with images [N, H, W, 3] uint8.
    Raises:
        DataError: the labels have no SMPL parameters or no intrinsics, the body file is wrong, the number of seeds
            differs, or the renderer needs an OpenGL that is not there.
    """
    if len(seeds) != len(labels):
        raise DataError(f"condition 'normals': {len(labels)} labels but {len(seeds)} seeds")
    images = render_labelled_normals(
        labels,
        image_size,
        "condition 'normals'",
        convention=options.convention,
        body_file=options.body,
        renderer=options.renderer,
        workers=options.workers,
    )
    return Conditions((options.prompt,) * len(labels), images)


def turn(images: np.ndarray, turns: np.ndarray, options: Options) -> np.ndarray:
    """Square maps [N, S, S, 3] uint8 in `turns` [N] quarter turns against the clock, colours turned with the body."""
    from ctlev_core.render.normals import turn_normal_map

    maps = [turn_normal_map(image, int(count), options.convention) for image, count in zip(images, turns, strict=True)]
    return np.stack(maps)
