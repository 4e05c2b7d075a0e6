"""The skeleton drawing: right colours in the right places, and no input that breaks it."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.geometry.joint_sets import JOINT_SETS, SMPL_JOINTS, openpose_sources
from ctlev_core.render import skeleton
from ctlev_core.render.skeleton import draw_skeleton
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
WHEEL = [
    [255, 0, 0], [255, 85, 0], [255, 170, 0], [255, 255, 0], [170, 255, 0], [85, 255, 0], [0, 255, 0], [0, 255, 85],
    [0, 255, 170], [0, 255, 255], [0, 170, 255], [0, 85, 255], [0, 0, 255], [85, 0, 255], [170, 0, 255], [255, 0, 255],
    [255, 0, 170], [255, 0, 85],
]  # fmt: skip


def draw(joints=JOINTS, visible=SEEN, size=SIZE, drawing="smooth"):
    return draw_skeleton(joints, visible, "dhp19", size, drawing)


def slow_smooth(joints, visible, joint_set, size):
    """The whole picture on the fine canvas, averaged by OpenCV."""
    width, height = size
    positions = [skeleton._mean([tuple(joints[i]) if visible[i] else None for i in parts])
                 for parts in openpose_sources(joint_set)]  # fmt: skip
    canvas = np.zeros((4 * height, 4 * width, 3), np.uint8)
    fixed = {
        number: tuple(np.rint((np.array(at) * 4 - 0.5) * 16).astype(int).tolist())
        for number, at in enumerate(positions)
        if at is not None
    }
    for colour, (start, end) in zip(skeleton.COLOURS, skeleton.LIMBS, strict=False):
        if start in fixed and end in fixed:
            cv2.line(canvas, fixed[start], fixed[end], colour, max(1, round(min(size) / 8)), cv2.LINE_AA, 4)
    for number, at in fixed.items():
        cv2.circle(canvas, at, round(1.5 * min(size)), skeleton.COLOURS[number], -1, cv2.LINE_AA, 4)
    return cv2.resize(canvas, size, interpolation=cv2.INTER_AREA)


def controlnet_v1(joints, visible, joint_set, size, stick_width):
    """As ControlNet v1.0 draws: its arithmetic on `candidate` and `subset`, whole pictures blended a limb at a time."""
    limbs = [[2, 3], [2, 6], [3, 4], [4, 5], [6, 7], [7, 8], [2, 9], [9, 10], [10, 11], [2, 12], [12, 13], [13, 14],
             [2, 1], [1, 15], [15, 17], [1, 16], [16, 18]]  # fmt: skip
    candidate = {}
    for number, parts in enumerate(openpose_sources(joint_set)):
        if parts and all(visible[i] and np.isfinite(joints[i]).all() for i in parts):
            x, y = np.floor(np.mean([joints[i] for i in parts], axis=0))
            if 0 <= x < size[0] and 0 <= y < size[1]:
                candidate[number] = (x, y)
    canvas = np.zeros((size[1], size[0], 3), np.uint8)
    for number in range(18):
        if number in candidate:
            x, y = candidate[number]
            cv2.circle(canvas, (int(x), int(y)), stick_width, WHEEL[number], thickness=-1)
    for number, limb in enumerate(limbs):
        if any(end - 1 not in candidate for end in limb):
            continue
        above = canvas.copy()
        ys, xs = ([candidate[end - 1][axis] for end in limb] for axis in (1, 0))
        length = np.hypot(xs[0] - xs[1], ys[0] - ys[1])
        angle = math.degrees(math.atan2(ys[0] - ys[1], xs[0] - xs[1]))
        centre = int(np.mean(xs)), int(np.mean(ys))
        polygon = cv2.ellipse2Poly(centre, (int(length / 2), stick_width), int(angle), 0, 360, 1)
        cv2.fillConvexPoly(above, np.array(polygon), WHEEL[number])
        canvas = cv2.addWeighted(canvas, 0.4, above, 0.6, 0)
    return canvas


def only(*names):
    return np.array([name in names for name in NAMES])


def test_limbs_have_the_colours_of_openpose():
    image = draw()
    limbs = {
        (255, 0, 0): ("neck", "right_shoulder"), (255, 85, 0): ("neck", "left_shoulder"),
        (255, 170, 0): ("right_shoulder", "right_elbow"), (255, 255, 0): ("right_elbow", "right_hand"),
        (170, 255, 0): ("left_shoulder", "left_elbow"), (85, 255, 0): ("left_elbow", "left_hand"),
        (0, 255, 0): ("neck", "right_hip"), (0, 255, 85): ("right_hip", "right_knee"),
        (0, 255, 170): ("right_knee", "right_foot"), (0, 255, 255): ("neck", "left_hip"),
        (0, 170, 255): ("left_hip", "left_knee"), (0, 85, 255): ("left_knee", "left_foot"),
        (0, 0, 255): ("neck", "head"),
    }  # fmt: skip
    for colour, (start, end) in limbs.items():
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
@given(
    st.lists(anything, min_size=26, max_size=26),
    st.lists(st.booleans(), min_size=13, max_size=13),
    st.sampled_from(skeleton.DRAWINGS),
)
def test_never_fails(values, visible, drawing):
    joints = np.array(values).reshape(13, 2)
    before = joints.copy()
    image = draw(joints, np.array(visible), drawing=drawing)
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


def random_pose(seed, joint_set, size, spread):
    random = np.random.default_rng(seed)
    count = len(JOINT_SETS[joint_set].joints)
    return random.normal(0.5, spread, (count, 2)) * size, random.random(count) < 0.85


@pytest.mark.parametrize("joint_set", JOINT_SETS)
@pytest.mark.parametrize("size", [(64, 64), (96, 95), (256, 256), (346, 260), (1601, 120), (61, 200), (5, 3), (1, 1)])
def test_the_smooth_drawing_is_that_of_the_whole_canvas(joint_set, size):
    for seed in range(6):
        joints, visible = random_pose(seed, joint_set, size, (0.15, 0.3, 0.8)[seed % 3])
        expected = slow_smooth(joints, visible, joint_set, size)
        np.testing.assert_array_equal(draw_skeleton(joints, visible, joint_set, size), expected)


@pytest.mark.parametrize("joint_set", JOINT_SETS)
@pytest.mark.parametrize("size", [(512, 512), (256, 256), (640, 512), (61, 200), (1, 1)])
def test_the_openpose_drawing_is_controlnets_to_the_pixel(joint_set, size):
    for seed in range(6):
        joints, visible = random_pose(seed, joint_set, size, (0.15, 0.3, 0.8)[seed % 3])
        expected = controlnet_v1(joints, visible, joint_set, size, 4)
        found = draw_skeleton(joints, visible, joint_set, size, "openpose", 4)
        np.testing.assert_array_equal(found, expected)
        if min(size) == 512:
            np.testing.assert_array_equal(draw_skeleton(joints, visible, joint_set, size, "openpose"), expected)


def test_openpose_joints_on_one_pixel_and_on_the_border():
    joints = np.array([[0, 0], [511.9, 511.9], [256, 256], [256, 256], [0.5, 511], *[[300.2, 100.9]] * 8])
    found = draw_skeleton(joints, SEEN, "dhp19", (512, 512), "openpose")
    np.testing.assert_array_equal(found, controlnet_v1(joints, SEEN, "dhp19", (512, 512), 4))


def test_openpose_has_no_joints_outside_the_image():
    joints = JOINTS * 8
    joints[NAMES.index("left_hand")] = [1e9, 28.0]
    joints[NAMES.index("right_hand")] = [-0.01, 28.0]
    joints[NAMES.index("head")] = [256, 512.0]
    expected = draw_skeleton(JOINTS * 8, ~only("left_hand", "right_hand", "head"), "dhp19", (512, 512), "openpose")
    np.testing.assert_array_equal(draw_skeleton(joints, SEEN, "dhp19", (512, 512), "openpose"), expected)


def test_openpose_widths_follow_the_image():
    for side, width in ((1024, 8), (512, 4), (256, 2), (192, 2), (128, 1), (64, 1)):
        image = draw_skeleton(JOINTS * side / 64, only("head"), "dhp19", (side, side), "openpose")
        rows, columns = np.nonzero(image.any(axis=2))
        assert np.ptp(rows) == np.ptp(columns) == 2 * width
        # The middle pixel is the one in which the joint lies.
        assert (rows.min() + rows.max()) / 2 == 8 * side // 64 and (
            columns.min() + columns.max()
        ) / 2 == 32 * side // 64


def test_openpose_blends_limbs_over_joints():
    image = draw_skeleton(JOINTS * 8, only("left_knee", "left_foot"), "dhp19", (512, 512), "openpose")
    x, y = np.array(FRONT["left_knee"]) * 8 + [1, 3]  # on the disc, and on the limb, which starts at its middle
    # .4 of the joint's colour 12 and .6 of the limb's colour 11; alone, .6 of the limb's.
    np.testing.assert_array_equal(image[y, x], np.rint(0.4 * np.array(WHEEL[12]) + 0.6 * np.array(WHEEL[11])))
    middle = (np.array(FRONT["left_knee"]) + FRONT["left_foot"]) * 4
    np.testing.assert_array_equal(image[middle[1], middle[0]], np.rint(0.6 * np.array(WHEEL[11])))


def pose_in(joint_set, names):
    """The asymmetric person of `names` in the order of a joint set; other joints are not visible."""
    joints = np.full((len(JOINT_SETS[joint_set].joints), 2), np.nan)
    for index, name in enumerate(JOINT_SETS[joint_set].joints):
        joints[index] = names.get(name, (np.nan, np.nan))
    return joints, np.asarray(np.isfinite(joints).all(axis=1))


@pytest.mark.parametrize("drawing", skeleton.DRAWINGS)
def test_the_same_person_is_drawn_alike_from_every_joint_set(drawing):
    """A person with only the right arm raised: a set whose sides are mistaken draws another picture."""
    person = {**FRONT, "right_elbow": (12, 10), "right_hand": (8, 2), "left_knee": (50, 44), "left_foot": (54, 58)}
    alike = {**person, "nose": person["head"], "neck": (32, 18)}
    for side in ("left", "right"):
        alike |= {f"{side}_wrist": person[f"{side}_hand"], f"{side}_ankle": person[f"{side}_foot"]}
    of_smpl = alike | {"left_hand": (60, 60), "right_hand": (1, 1), "left_foot": (2, 60), "right_foot": (60, 2)}
    of_smpl["neck"] = (32, 30)  # SMPL's own, which is not OpenPose's
    images = {
        name: draw_skeleton(*pose_in(name, of_smpl if name == "smpl" else alike), name, SIZE, drawing)
        for name in JOINT_SETS
    }
    for name, image in images.items():
        np.testing.assert_array_equal(image, images["dhp19"], err_msg=name)
    # The raised hand is the person's right one, left in the picture, and its fore-arm has the fourth colour.
    patch = images["cdehp"][5:8, 9:12].reshape(-1, 3).astype(int)
    assert (patch[:, 0] > 90).any() and (patch[:, 1] > 90).any() and (patch[:, 2] < 30).all()


def test_joints_that_stand_for_openposes():
    names = JOINT_SETS["openpose"].joints
    for joint_set, expected in {
        # facts of the data sets' own orders: SensorsINI/DHP19 and CDEHP's annotation.md
        "dhp19": [0, (1, 2), 1, 3, 7, 2, 4, 8, 5, 9, 11, 6, 10, 12],
        "cdehp": [0, (1, 2), 2, 4, 6, 1, 3, 5, 8, 10, 12, 7, 9, 11],
        "smpl": [15, (16, 17), 17, 19, 21, 16, 18, 20, 2, 5, 8, 1, 4, 7],
    }.items():
        sources = [tuple(sorted(parts)) for parts in openpose_sources(joint_set)]
        assert sources == [part if isinstance(part, tuple) else (part,) for part in expected] + [()] * 4
    assert openpose_sources("openpose") == tuple((index,) for index in range(18))
    assert names[4] == "right_wrist" and SMPL_JOINTS[21] == "right_wrist"
    assert [names[i] for i in JOINT_SETS["openpose"].mirror[14:]] == ["left_eye", "right_eye", "left_ear", "right_ear"]


@pytest.mark.parametrize("drawing", skeleton.DRAWINGS)
def test_hopeless_joints_give_a_black_picture(drawing):
    far = np.full((13, 2), 1e9)
    opposite = np.where(np.arange(13)[:, None] % 2, 1.7e308, -1.7e308) * np.ones(2)
    for joints, visible in (
        (far, SEEN),
        (-far, SEEN),
        (opposite, SEEN),
        (np.full((13, 2), np.nan), SEEN),
        (JOINTS, ~SEEN),
    ):
        image = draw_skeleton(joints, visible, "dhp19", SIZE, drawing)
        assert image.shape == (64, 64, 3) and not image.any()
    tiny = draw_skeleton(np.full((13, 2), 0.5), SEEN, "dhp19", (1, 1), drawing)
    assert tiny.shape == (1, 1, 3) and tiny.any()


@pytest.mark.parametrize("drawing", skeleton.DRAWINGS)
def test_pictures_without_pixels_are_an_error(drawing):
    for size in ((0, 64), (64, 0), (0, 0), (-3, 5)):
        with pytest.raises(DataError, match="1 px or more"):
            draw_skeleton(JOINTS, SEEN, "dhp19", size, drawing)


def test_wrong_drawings_are_named():
    with pytest.raises(ValueError, match="unknown drawing 'stick'; known: smooth, openpose"):
        draw_skeleton(JOINTS, SEEN, "dhp19", SIZE, "stick")
    with pytest.raises(ValueError, match="stick width"):
        draw_skeleton(JOINTS, SEEN, "dhp19", SIZE, "openpose", 0)
