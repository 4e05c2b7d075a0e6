"""Numbers of time: frames made by hand whose numbers are known, order against none, intervals, bad input."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from ctlev_core.realism.sequences import STILL_DISTANCE, LabelledJoints, estimate_numbers, measure_stretch
from ctlev_core.realism.stretches import shuffle_time
from ctlev_core.render.skeleton import draw_skeleton

LENGTH, SIDE = 8, 64
TEXTURE = np.random.default_rng(0).integers(100, 255, (9, 9)).astype(np.uint8)


def value(frames: np.ndarray, name: str, labelled: LabelledJoints | None = None) -> float:
    numerator, denominator = measure_stretch(frames, labelled)[name]
    return numerator / denominator


def moving_block(
    step: tuple[int, int], block: np.ndarray = TEXTURE, channels: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """A block that moves by (x, y) px a frame through the middle, and where its middle is, [L, 2] px."""
    frames = np.zeros((LENGTH, SIDE, SIDE, channels), np.uint8)
    middles = np.zeros((LENGTH, 2))
    for number, frame in enumerate(frames):
        x, y = (SIDE // 2 + (number - LENGTH // 2) * by for by in step)
        frame[y - 4 : y + 5, x - 4 : x + 5, 0] = block
        middles[number] = x + 0.5, y + 0.5
    return frames, middles


def joints_at(middles: np.ndarray) -> LabelledJoints:
    return LabelledJoints(np.repeat(middles[:, None], 13, axis=1), "dhp19")


@pytest.mark.parametrize("step", [(2, 0), (0, 2), (-2, 0), (2, -2)])
def test_flow_of_a_moving_block_agrees_with_its_label_and_not_with_the_opposite(step):
    frames, middles = moving_block(step)
    assert value(frames, "flow_agreement", joints_at(middles)) > 0.95
    backwards = joints_at(2 * middles[LENGTH // 2] - middles)
    near = slice(LENGTH // 2 - 1, LENGTH // 2 + 2)  # where the joint that goes back is still on the block
    assert value(frames[near], "flow_agreement", LabelledJoints(backwards.joints2d[near], "dhp19")) < -0.95
    sideways = middles[LENGTH // 2] + (middles - middles[LENGTH // 2])[:, ::-1] * [1, -1]
    across = LabelledJoints(joints_at(sideways).joints2d[near], "dhp19")
    assert abs(value(frames[near], "flow_agreement", across)) < 0.2


def test_of_two_joints_the_faster_counts_more():
    # Nothing moves where the second joint is: its cosine is 0, and the mean is the first one's share of the way.
    frames, middles = moving_block((2, 0))
    elsewhere = np.stack([np.full(LENGTH, 5.5), 5.5 + np.arange(LENGTH)], axis=1)
    joints = joints_at(middles).joints2d
    joints[:, 0] = elsewhere
    assert value(frames, "flow_agreement", LabelledJoints(joints, "dhp19")) == pytest.approx(24 / 25, abs=0.03)


def test_joints_that_keep_still_leave_the_image_or_are_unknown_have_no_direction():
    frames, middles = moving_block((2, 0))
    for places in (middles[:1].repeat(LENGTH, axis=0), middles + SIDE, np.full_like(middles, np.nan)):
        assert measure_stretch(frames, joints_at(places))["flow_agreement"] == (0.0, 0.0)


def test_larger_images_have_the_same_directions():
    frames, middles = moving_block((2, 0))
    large = frames.repeat(3, axis=1).repeat(3, axis=2)
    assert value(large, "flow_agreement", joints_at(3 * middles)) > 0.95


@pytest.mark.parametrize(("step", "stays"), [(0, 1.0), (1, 1.0), (2, 8 / 9), (4, 6 / 9), (9, 1 / 9), (10, 0.0)])
def test_pixels_stay_that_are_active_within_one_pixel(step, stays):
    # Of 9 columns those stay that lie within 1 px of the next place: 9 - (step - 1).
    frames = np.zeros((4, 20, 60, 1), np.uint8)
    for number, frame in enumerate(frames):
        frame[5:9, 2 + step * number : 11 + step * number] = 200
    assert value(frames, "persistent_share") == pytest.approx(stays)


def frames_of_counts(counts: list[int]) -> np.ndarray:
    frames = np.zeros((len(counts), 10, 10, 1), np.uint8)
    for frame, count in zip(frames, counts, strict=True):
        frame.reshape(-1)[:count] = 25
    return frames


def test_the_correlation_of_a_ramp_is_that_of_its_variogram():
    # Variance of 1 .. L with L - 1: L (L + 1) / 12; squared difference k^2: 1 - 6 k^2 / (L (L + 1)).
    ramp = frames_of_counts([5 * number for number in range(1, LENGTH + 1)])
    for lag in (1, 2, 4):
        assert value(ramp, f"rate_correlation_lag{lag}") == pytest.approx(1 - 6 * lag**2 / (LENGTH * (LENGTH + 1)))
    turns = frames_of_counts([10, 30] * (LENGTH // 2))
    assert value(turns, "rate_correlation_lag1") == pytest.approx(1 - 2 * (LENGTH - 1) / LENGTH)
    assert value(turns, "rate_correlation_lag2") == value(turns, "rate_correlation_lag4") == 1


def test_without_order_the_correlation_is_exactly_zero_on_average():
    counts = [3, 50, 7, 24, 90]
    sums = [measure_stretch(frames_of_counts(list(order))) for order in permutations(counts)]
    names = ["r"] * len(sums)
    for lag in (1, 2, 4):
        assert estimate_numbers(sums, names)[f"rate_correlation_lag{lag}"].value == pytest.approx(0, abs=1e-12)


def test_a_lag_longer_than_the_stretch_is_left_out():
    found = measure_stretch(frames_of_counts([1, 2, 3, 4]))
    assert "rate_correlation_lag2" in found and "rate_correlation_lag4" not in found


def still_mask(joints: np.ndarray) -> np.ndarray:
    """Pixel by pixel: far from everything that is drawn in any frame."""
    drawn = np.zeros((SIDE, SIDE), bool)
    for each in joints:
        drawn |= draw_skeleton(each, np.ones(13, bool), "dhp19", (SIDE, SIDE)).any(axis=-1)
    places, every = np.argwhere(drawn), np.argwhere(np.ones((SIDE, SIDE), bool))
    distance = np.linalg.norm(every[:, None] - places[None], axis=-1).min(axis=1)
    return (distance > STILL_DISTANCE * SIDE).reshape(SIDE, SIDE)


def test_still_pixels_are_far_from_the_skeleton_in_all_frames():
    rng = np.random.default_rng(0)
    joints = rng.uniform(20, 44, (1, 13, 2)) + np.arange(LENGTH)[:, None, None] * [1.5, 0]
    still = still_mask(joints)
    assert 500 < still.sum() < SIDE * SIDE - 500
    # Active in the first half of the frames: all that is not still, and 7 still pixels in each of them.
    frames = np.zeros((LENGTH, SIDE, SIDE, 1), np.uint8)
    frames[:4][:, ~still] = 200
    y, x = np.argwhere(still)[::50][:7].T
    frames[:4, y, x] = 200
    found = measure_stretch(frames, LabelledJoints(joints, "dhp19"))
    assert found["still_active_share"] == (28.0, LENGTH * float(still.sum()))
    assert found["still_repeat_ratio"] == (21.0, pytest.approx(3 * 49 / still.sum()))


def test_noise_strikes_a_pixel_again_by_chance_and_a_hot_pixel_more_often():
    joints = joints_at(np.full((LENGTH, 2), SIDE / 2))
    rng = np.random.default_rng(0)
    noise = [(rng.random((LENGTH, SIDE, SIDE, 1)) < 0.05) * np.uint8(200) for _ in range(20)]
    names = [f"r{number}" for number in range(20)]
    found = estimate_numbers([measure_stretch(frames, joints) for frames in noise], names)["still_repeat_ratio"]
    assert found.low < 1 < found.high and found.value == pytest.approx(1, abs=0.05)
    hot = np.zeros((LENGTH, SIDE, SIDE, 1), np.uint8)
    hot[:, 1, 1] = 200
    # One pixel of all in every frame: twice in a row as often as there are still pixels more than by chance.
    assert value(hot, "still_repeat_ratio", joints) == pytest.approx(still_mask(joints.joints2d).sum())


def test_a_joint_that_is_not_known_may_be_anywhere():
    joints = joints_at(np.full((LENGTH, 2), SIDE / 2))
    joints.joints2d[3, 5] = np.nan
    frames, _ = moving_block((2, 0))
    found = measure_stretch(frames, joints)
    assert "still_active_share" not in found and "flow_agreement" in found
    outside = joints_at(np.full((LENGTH, 2), 10 * SIDE))
    assert "still_active_share" not in measure_stretch(frames, outside), "nobody is seen to be far from"


def test_polarity_stays_with_an_edge_and_turns_with_a_sign():
    frames, _ = moving_block((2, 0), channels=2)
    assert value(frames, "polarity_kept_share") == 1
    turned = frames.copy()
    turned[1::2] = frames[1::2, ..., ::-1]
    assert value(turned, "polarity_kept_share") == 0
    # A leading edge of one sign and a trailing one of the other, farther apart than the way of a frame.
    edges = np.zeros((LENGTH, SIDE, SIDE, 2), np.uint8)
    for number, frame in enumerate(edges):
        frame[20:44, 8 + 2 * number : 11 + 2 * number, 0] = frame[20:44, 24 + 2 * number : 27 + 2 * number, 1] = 200
    assert value(edges, "polarity_kept_share") > 0.95
    assert "polarity_kept_share" not in measure_stretch(frames[..., :1])


def test_shuffled_time_is_the_end_without_order():
    rng = np.random.default_rng(0)
    stretches, labels = [], []
    for _ in range(12):
        direction = rng.permutation([(2, 0), (-2, 0), (0, 2), (0, -2)])[0]
        frames, middles = moving_block(tuple(direction.tolist()))
        frames[np.arange(LENGTH), 0, :, 0] = (np.arange(SIDE) < 4 * np.arange(LENGTH)[:, None]) * 200
        stretches.append(frames)
        labels.append(joints_at(middles))
    names = [f"r{number}" for number in range(12)]

    def numbers(frames):
        return estimate_numbers([measure_stretch(*pair) for pair in zip(frames, labels, strict=True)], names)

    ordered, shuffled = numbers(stretches), numbers(shuffle_time(np.stack(stretches)))
    assert ordered["flow_agreement"].value > 0.9 and abs(shuffled["flow_agreement"].value) < 0.3
    assert ordered["rate_correlation_lag1"].value > 0.9
    assert shuffled["rate_correlation_lag1"].low < 0.25 and shuffled["rate_correlation_lag1"].value < 0.4
    assert ordered["persistent_share"].value > shuffled["persistent_share"].value + 0.2


def test_intervals_are_over_recordings_and_need_five():
    sums = [{"persistent_share": (float(number % 2), 1.0)} for number in range(16)]
    two_each = [f"r{number // 4}" for number in range(16)]
    (few,) = estimate_numbers(sums, two_each).values()
    assert few.value == 0.5 and np.isnan(few.low) and np.isnan(few.high)
    # Two halves of each recording differ, the recordings do not.
    alike = estimate_numbers(sums, [f"r{number // 2}" for number in range(16)])["persistent_share"]
    assert alike.low == alike.value == alike.high == 0.5
    differing = estimate_numbers(sums, [f"r{number % 16}" for number in range(16)])["persistent_share"]
    assert differing.low < 0.35 and differing.high > 0.65
    assert differing == estimate_numbers(sums, [f"r{number % 16}" for number in range(16)])["persistent_share"]


def test_a_number_that_few_recordings_have_is_given_without_interval():
    sums = [{"a": (1.0, 2.0), "b": (1.0, 1.0) if number < 2 else (0.0, 0.0)} for number in range(6)]
    found = estimate_numbers(sums, [f"r{number}" for number in range(6)])
    assert found["a"].low == 0.5 and found["b"].value == 1 and np.isnan(found["b"].low)


def test_empty_frames_have_no_numbers_but_how_active_still_pixels_are():
    empty = np.zeros((LENGTH, SIDE, SIDE, 2), np.uint8)
    found = estimate_numbers([measure_stretch(empty, joints_at(np.full((LENGTH, 2), 30.0)))], ["r"])
    assert {name: estimate.value for name, estimate in found.items()} == {"still_active_share": 0.0}
    assert estimate_numbers([], []) == {}


@pytest.mark.parametrize(
    "frames",
    [
        np.zeros((1, 8, 8, 1), np.uint8),
        np.zeros((3, 8, 8), np.uint8),
        np.zeros((3, 8, 8, 1)),
        np.zeros((3, 0, 8, 1), np.uint8),
    ],
)
def test_what_is_no_stretch_is_refused(frames):
    with pytest.raises(ValueError, match=r"a stretch must be \[2 frames or more, H, W, C\] uint8"):
        measure_stretch(frames)


def test_joints_of_another_number_of_frames_are_refused():
    with pytest.raises(ValueError, match=r"joints must be \[8, J, 2\], got \(7, 13, 2\)"):
        measure_stretch(np.zeros((8, 9, 9, 1), np.uint8), LabelledJoints(np.zeros((7, 13, 2)), "dhp19"))
