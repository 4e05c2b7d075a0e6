"""The skeleton drawing: right colours in the right places, and no input that breaks it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.render import skeleton
from ctlev_core.render.skeleton import draw_skeleton
from ctlev_core.skeletons import JOINT_SETS
from data_contracts.errors import DataError

NAMES = JOINT_SETS["dhp19"].joints
SIZE = (64, 64)
# A person seen from the front: the right side is on the left of the picture.
FRONT = {
    "head": (32, 8), "right_shoulder": (22, 18), "left_shoulder": (42, 18), "right_elbow": (16, 28),
    "left_elbow": (48, 28), "right_hip": (27, 36), "left_hip": (37, 36), "right_hand": (10, 38), "left_hand": (54, 38),
    "right_knee": (25, 48), "left_knee": (39, 48), "right_foot": (23, 60), "left_foot": (41, 60),
}  # fmt: skip
JOINTS = np.array([FRONT[name] for name in NAMES], float)
SEEN = np.ones(13, bool)


def draw(joints=JOINTS, visible=SEEN, size=SIZE):
    return draw_skeleton(joints, visible, "dhp19", size)


def only(*names):
    return np.array([name in names for name in NAMES])


def test_limbs_have_the_colours_of_openpose():
    image = draw()
    for colour, (start, end) in zip(skeleton.COLOURS, skeleton.LIMBS, strict=False):
        ends = [np.array(FRONT[name]) if name != "neck" else (JOINTS[1] + JOINTS[2]) / 2 for name in (start, end)]
        x, y = np.mean(ends, axis=0).astype(int)
        patch = image[y - 1 : y + 2, x - 1 : x + 2].reshape(-1, 3).astype(int)
        assert np.abs(patch - colour).sum(axis=1).min() < 60, (start, end)


def test_joints_are_drawn_where_they_are():
    image = draw(visible=only("head"))
    rows, columns = np.nonzero(image.any(axis=2))
    weight = image.sum(axis=2)[rows, columns]
    # Pixel centres at integer + 0.5: the centre of mass of the dot is the joint.
    assert abs(np.average(columns + 0.5, weights=weight) - 32) < 0.1
    assert abs(np.average(rows + 0.5, weights=weight) - 8) < 0.1
    assert image[7:9, 31:33].max() == 255


def test_moves_by_less_than_a_pixel():
    def centre(shift):
        image = draw(JOINTS + np.array([shift, 0]), only("head"))
        return np.average(np.arange(64), weights=image.sum(axis=(0, 2)))

    for shift in (0.25, 0.5, 0.75):
        assert abs(centre(shift) - centre(0) - shift) < 0.08


def test_whole_pixels_shift_the_picture():
    np.testing.assert_array_equal(
        draw(JOINTS + np.array([3, -2]))[4:60, 8:60], np.roll(draw(), (-2, 3), (0, 1))[4:60, 8:60]
    )


def test_scales_with_the_image():
    large = draw(JOINTS * 4, size=(256, 256))
    import cv2

    small = cv2.resize(large, SIZE, interpolation=cv2.INTER_AREA)
    assert np.abs(small.astype(int) - draw()).mean() < 4.0


def test_invisible_joints_and_their_limbs_are_left_out():
    assert not draw(visible=~SEEN).any()
    image = draw(visible=only("left_elbow", "left_hand", "right_knee"))
    assert image[32:35, 50:53].any() and image[47:49, 24:26].any()
    assert not image[:26].any() and not image[40:, 30:].any()


def test_a_visible_shoulder_alone_has_no_neck():
    image = draw(visible=only("left_shoulder", "head"))
    assert not image[12:15, 30:38].any()


def test_limbs_that_leave_the_image_are_drawn_up_to_its_border():
    joints = JOINTS.copy()
    joints[NAMES.index("left_hand")] = [1e6, 28.0]
    image = draw(joints, only("left_elbow", "left_hand"))
    assert image[27:29, 63].any() and not image[:26].any() and not image[31:].any()


def test_non_square_images():
    image = draw(JOINTS, size=(80, 70))
    assert image.shape == (70, 80, 3) and image.dtype == np.uint8 and image.any()


anything = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True, width=64), st.floats(-200, 200), st.just(float("nan"))
)


@settings(deadline=None, max_examples=80)
@given(st.lists(anything, min_size=26, max_size=26), st.lists(st.booleans(), min_size=13, max_size=13))
def test_never_fails(values, visible):
    joints = np.array(values).reshape(13, 2)
    before = joints.copy()
    image = draw(joints, np.array(visible))
    assert image.shape == (64, 64, 3)
    np.testing.assert_array_equal(joints, before)
    if not any(np.isfinite(joints[i]).all() and visible[i] for i in range(13)):
        assert not image.any()


def test_bad_input_is_named():
    with pytest.raises(DataError, match="unknown joint set 'coco'"):
        draw_skeleton(JOINTS, SEEN, "coco", SIZE)
    with pytest.raises(DataError, match=r"needs joints2d \[13, 2\]"):
        draw(JOINTS[:12])
    with pytest.raises(DataError, match=r"visible \[13\]"):
        draw(visible=SEEN[:12])
