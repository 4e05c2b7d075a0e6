"""What generators and downstream models return, looked at before it is used: a plug-in's mistake has its name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ctlev_core.plugins import Plugin, PluginError
from data_contracts.image_rows import Images

_SHAPES: dict[str, dict[str, tuple[str | int, ...]]] = {
    "joints2d": {"joints2d": ("N", "J", 2)},
    "joints3d": {"joints3d": ("N", "J", 3)},
    "smpl": {"smpl_pose": ("N", 72), "smpl_betas": ("N", 10), "smpl_transl": ("N", 3)},
    "classes": {"probability": ("N", "K"), "classes": ("K",)},
}
"""Of arrays, by what `PREDICTS` calls them."""


def predict_frames(
    plugin: Plugin, model: Path, frames: Images, predict: Callable[[Path, Images], Any] | None = None
) -> Mapping[str, np.ndarray]:
    """Predictions of the model in a folder for N frames.

    Args:
        plugin: of `downstream`.
        model: folder that it was trained to.
        frames: [N, H, W, 3] uint8.
        predict: a function of the plug-in other than `predict`.
    Raises:
        PluginError: they are not what its `PREDICTS` promises, a row a frame.
    """
    found = (predict or plugin.module.predict)(model, frames)
    name = f"downstream {plugin.name!r}"
    if not isinstance(found, Mapping):
        raise PluginError(f"{name}: predictions must be arrays by name, got {type(found).__name__}")
    for array, shape in (item for what in plugin.module.PREDICTS for item in _SHAPES.get(what, {}).items()):
        if array not in found:
            raise PluginError(f"{name}: predictions must hold {array!r}, got {', '.join(found) or 'nothing'}")
        got = np.shape(found[array])
        wanted = [len(frames) if side == "N" else side for side in shape]
        if len(got) != len(wanted) or any(side not in (one, "J", "K") for one, side in zip(got, wanted, strict=True)):
            raise PluginError(
                f"{name}: predictions of {len(frames)} frames must have {array} [{', '.join(map(str, shape))}], got "
                f"{list(got)}"
            )
    if "classes" in plugin.module.PREDICTS and np.shape(found["probability"])[1] != len(found["classes"]):
        raise PluginError(
            f"{name}: probability must have a column for each of {len(found['classes'])} classes, got "
            f"{np.shape(found['probability'])[1]}"
        )
    return found


def features_of_frames(plugin: Plugin, model: Path, frames: Images) -> np.ndarray:
    """Features [N, D] of N frames by the model in a folder.

    Raises:
        PluginError: they have another shape.
    """
    features = plugin.module.features(model, frames)
    if np.ndim(features) != 2 or len(features) != len(frames):
        raise PluginError(
            f"feature_extractor {plugin.name!r}: features of {len(frames)} frames must be [N, D], got "
            f"{list(np.shape(features))}"
        )
    return features


def check_samples(plugin: Plugin, made: Any, count: int) -> np.ndarray:
    """The frames themselves, `count` that a generator made.

    Raises:
        PluginError: they are no [N, H, W, 3] uint8.
    """
    shape, kind = np.shape(made), getattr(made, "dtype", type(made).__name__)
    if len(shape) != 4 or (shape[0], shape[3]) != (count, 3) or kind != np.uint8:
        raise PluginError(
            f"generator {plugin.name!r}: samples of {count} conditions must be [{count}, H, W, 3] uint8, got "
            f"{list(shape)} {kind}"
        )
    return made
