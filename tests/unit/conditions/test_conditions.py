"""Skeleton and text conditions."""

import numpy as np
import pytest

from ctlev_core.conditions import skeleton, text
from ctlev_core.plugins import PluginError, load_options
from ctlev_core.render.skeleton import draw_skeleton
from data_contracts.config import ConditionChoice
from data_contracts.errors import DataError
from data_contracts.labels import Labels


def pose_labels(count=3):
    joints2d = np.random.default_rng(0).uniform(5, 43, (count, 13, 2)).astype(np.float32)
    visible = np.random.default_rng(1).random((count, 13)) < 0.8
    return Labels(("walk",) * count, np.zeros(count, np.int64), joints2d, visible, "dhp19")


def class_labels(*names):
    return Labels(names, np.zeros(len(names), np.int64))


def test_skeleton_draws_each_row_and_repeats_the_prompt():
    labels = pose_labels()
    conditions = skeleton.render(labels, (48, 40), skeleton.Options(), [0, 1, 2])
    assert conditions.prompts == ("A moving human",) * 3
    assert conditions.images is not None and conditions.images.shape == (3, 40, 48, 3)
    assert conditions.images.dtype == np.uint8
    for row in range(3):
        expected = draw_skeleton(labels.joints2d[row], labels.visible[row], "dhp19", (48, 40))
        np.testing.assert_array_equal(conditions.images[row], expected)
    one = skeleton.render(labels.take([1]), (48, 40), skeleton.Options(), [9])
    np.testing.assert_array_equal(one.images[0], conditions.images[1])


def test_skeletons_are_drawn_as_asked():
    labels = pose_labels()
    assert labels.joints2d is not None and labels.visible is not None
    for options, arguments in (
        (skeleton.Options(drawing="openpose"), ("openpose", None)),
        (skeleton.Options(drawing="openpose", stick_width_px=3), ("openpose", 3)),
    ):
        images = skeleton.render(labels, (48, 40), options, [0, 1, 2]).images
        assert images is not None
        expected = draw_skeleton(labels.joints2d[2], labels.visible[2], "dhp19", (48, 40), *arguments)
        np.testing.assert_array_equal(images[2], expected)
        assert (images[2] != draw_skeleton(labels.joints2d[2], labels.visible[2], "dhp19", (48, 40))).any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"drawing": "stick"}, "'smooth' or 'openpose'"),
        ({"drawing": "openpose", "stick_width_px": 0}, "greater than or equal to 1"),
        ({"stick_width_px": 4}, "of drawing 'openpose'"),
    ],
)
def test_wrong_skeleton_options_are_named_before_anything_runs(options, message):
    with pytest.raises(PluginError, match=message):
        load_options(ConditionChoice(name="skeleton", options=options))


def test_skeleton_of_no_rows():
    conditions = skeleton.render(pose_labels().take([]), (48, 40), skeleton.Options(), [])
    assert len(conditions) == 0 and conditions.images.shape == (0, 40, 48, 3)


def test_skeleton_needs_joints_and_seeds():
    with pytest.raises(DataError, match="no joints2d"):
        skeleton.render(class_labels("dog"), (48, 40), skeleton.Options(), [0])
    with pytest.raises(DataError, match="3 labels but 1 seeds"):
        skeleton.render(pose_labels(), (48, 40), skeleton.Options(), [0])


def test_text_names_the_class():
    conditions = text.render(class_labels("sea_horse", "dog"), (64, 64), text.Options(), [3, 4])
    assert conditions.prompts == ("A photo of sea horse", "A photo of dog")
    assert conditions.images is None


def test_text_draws_synonyms_by_the_seed_of_the_row():
    options = text.Options(template="An event image of {class_name}.", synonyms={"dog": ["dog", "hound", "puppy"]})
    labels = class_labels(*["dog"] * 200)
    prompts = text.render(labels, (64, 64), options, list(range(200))).prompts
    assert set(prompts) == {f"An event image of {name}." for name in ("dog", "hound", "puppy")}
    reversed_prompts = text.render(labels, (64, 64), options, list(range(199, -1, -1))).prompts
    assert reversed_prompts == prompts[::-1]


def test_text_takes_braces_in_names_as_they_are():
    assert text.render(class_labels("a{b}"), (64, 64), text.Options(), [0]).prompts == ("A photo of a{b}",)


def test_text_refuses_rows_without_a_class():
    with pytest.raises(DataError, match="row 1 has no class name"):
        text.render(class_labels("dog", ""), (64, 64), text.Options(), [0, 1])
    with pytest.raises(DataError, match="1 labels but 2 seeds"):
        text.render(class_labels("dog"), (64, 64), text.Options(), [0, 1])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"template": "A photo"}, "must contain"),
        ({"synonyms": {"dog": []}}, "at least one synonym"),
        ({"synonyms": {"dog": [" "]}}, "at least one synonym"),
        ({"tempalte": "x"}, "unknown option 'tempalte'"),
    ],
)
def test_wrong_text_options_are_named_before_anything_runs(options, message):
    with pytest.raises(PluginError, match=message):
        load_options(ConditionChoice(name="text", options=options))
