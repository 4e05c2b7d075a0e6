"""A plug-in that returns something else than it promises is told so, with its name, before anything is scored."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ctlev_core.plugin_outputs import check_samples, features_of_frames, predict_frames
from ctlev_core.plugins import Plugin, PluginError

FRAMES = np.zeros((5, 8, 8, 3), np.uint8)
BODY = {
    "joints2d": np.zeros((5, 24, 2)),
    "joints3d": np.zeros((5, 24, 3)),
    "smpl_pose": np.zeros((5, 72)),
    "smpl_betas": np.zeros((5, 10)),
    "smpl_transl": np.zeros((5, 3)),
}
CLASSES = {"probability": np.zeros((5, 3)), "classes": np.array(["a", "b", "c"])}


def plugin(predicts, returned):
    module = SimpleNamespace(
        PREDICTS=predicts, predict=lambda model, frames: returned, features=lambda model, frames: returned
    )
    return Plugin("downstream", "mine", module, None)


def predicted(predicts, returned):
    return predict_frames(plugin(predicts, returned), Path("model"), FRAMES)


def test_what_is_promised_is_returned_as_it_is():
    body, classes = BODY | {"more": 1}, CLASSES | {"binary_probability": np.zeros((5, 3))}
    assert predicted(("joints2d", "joints3d", "smpl"), body) is body
    assert predicted(("classes",), classes) is classes
    other = plugin(("joints2d",), None)
    assert predict_frames(other, Path("model"), FRAMES, lambda model, frames: BODY) is BODY


@pytest.mark.parametrize(
    ("predicts", "returned", "message"),
    [
        (("joints2d",), [1, 2], "predictions must be arrays by name, got list"),
        (("joints2d",), {"joints": 1}, "predictions must hold 'joints2d', got joints"),
        (("joints2d",), {}, "predictions must hold 'joints2d', got nothing"),
        (
            ("joints2d",),
            {"joints2d": np.zeros((4, 13, 2))},
            r"predictions of 5 frames must have joints2d \[N, J, 2\], got \[4, 13, 2\]",
        ),
        (("joints3d",), {"joints3d": np.zeros((5, 13, 2))}, r"joints3d \[N, J, 3\], got \[5, 13, 2\]"),
        (("joints3d",), {"joints3d": np.zeros((5, 39))}, r"joints3d \[N, J, 3\], got \[5, 39\]"),
        (("smpl",), BODY | {"smpl_pose": np.zeros((5, 69))}, r"smpl_pose \[N, 72\], got \[5, 69\]"),
        (("classes",), CLASSES | {"classes": ["a", "b"]}, "a column for each of 2 classes, got 3"),
    ],
)
def test_anything_else_is_refused_with_the_name_of_the_plugin(predicts, returned, message):
    with pytest.raises(PluginError, match=f"downstream 'mine': .*{message}"):
        predicted(predicts, returned)


def test_samples_are_an_image_a_condition():
    assert check_samples(plugin((), None), FRAMES, 5) is FRAMES
    for wrong in (FRAMES[:4], FRAMES[..., :2], FRAMES.astype(float), FRAMES[0], None):
        with pytest.raises(PluginError, match=r"generator 'mine': samples of 5 .* must be \[5, H, W, 3\] uint8, got"):
            check_samples(plugin((), None), wrong, 5)


def test_features_are_a_row_a_frame():
    assert features_of_frames(plugin((), np.zeros((5, 7))), Path("model"), FRAMES).shape == (5, 7)
    for wrong in (np.zeros((4, 7)), np.zeros(5)):
        with pytest.raises(PluginError, match=r"feature_extractor 'mine': features of 5 frames must be \[N, D\], got"):
            features_of_frames(plugin((), wrong), Path("model"), FRAMES)
