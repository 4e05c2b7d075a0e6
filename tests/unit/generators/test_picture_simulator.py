"""Recorded pictures: events where, when and of the polarity that light says; a calibration that finds what made
them."""

from pathlib import Path

import numpy as np
import pytest

from ctlev_core.events import files as event_files
from ctlev_core.generators import picture_simulator
from ctlev_core.generators.picture_simulator import (
    UNCALIBRATED,
    SampleOptions,
    calibrate,
    sample_events,
)
from ctlev_core.render.panned_picture import pan
from ctlev_core.sensor.dvs_pixel import EventBudgetError
from data_contracts.errors import DataError
from data_contracts.events import check_events
from data_contracts.labels import Conditions

REAL = Path(__file__).resolve().parents[3].parent / "shared" / "real"
SIZE = (34, 34)
SIDE = 28
STILL = {
    "centre_jitter_px": 0.0, "blur_px": 0.0, "threshold_spread": 0.0, "leak_rate_hz": 0.0, "shot_noise_rate_hz": 0.0,
    "refractory_us": 0, "starts_settled": False, "centre_px": (0.0, 0.0), "hot_pixels": (), "flipped": False,
    "negative": False, "picture_share": SIDE / 34,
}  # fmt: skip
BLACK = 0.05


def conditions_of(images, names=None):
    images = np.asarray(images, np.uint8)
    return Conditions(("",) * len(images), np.repeat(images[..., None], 3, axis=3), None, names)


def strokes(count, seed=0):
    """Bright strokes on black, of two classes: upright, and lying."""
    rng = np.random.default_rng(seed)
    images = np.zeros((count, SIDE, SIDE), np.uint8)
    for number, image in enumerate(images):
        low, wide, far = rng.integers(8, 14), rng.integers(3, 6), rng.integers(18, 22)
        image[5:far, low : low + wide] = 255
        if number % 2:
            image[:] = image.T.copy()
    return conditions_of(images, tuple("ab"[number % 2] for number in range(count)))


def record(conditions, seeds=None, size=SIZE, **options):
    seeds = range(len(conditions)) if seeds is None else seeds
    return list(sample_events(conditions, size, SampleOptions(**options), seeds=seeds))


def signed(events):
    counts = np.zeros((2, *events.sensor_size[::-1]), int)
    np.add.at(counts, (events.p, events.y, events.x), 1)
    return counts


def same(first, second):
    return all(np.array_equal(getattr(first, name), getattr(second, name)) for name in "txyp")


def test_rows_depend_on_their_picture_and_seed_alone():
    asked = strokes(4)
    made = record(asked, [5, 6, 7, 8])
    for events in made:
        check_events(events, "test")
        assert events.sensor_size == SIZE and len(events) > 500
        assert events.t[0] >= 0 and events.t[-1] <= SampleOptions().path_us[-1]
    again = record(asked.take(np.array([2, 0])), [7, 5])
    assert same(again[0], made[2]) and same(again[1], made[0])
    assert not same(record(asked.take(np.array([0])), [9])[0], made[0])


@pytest.mark.parametrize("threshold", [0.2, 0.35])
def test_a_bright_edge_that_moves_right_sends_rising_light_ahead_as_often_as_thresholds_fit(threshold):
    """A bright half moves 3 px to the right: three columns go from black to white, no others change at all."""
    image = np.zeros((1, SIDE, SIDE))
    image[:, :, : SIDE // 2] = 255
    options = STILL | {"threshold": threshold, "black": BLACK, "path_us": (0, 100_000), "path_px": ((0, 0), (3, 0))}
    middle, inside = SIZE[0] // 2, slice(8, 26)  # rows and columns whose surroundings are the picture
    (events,) = record(conditions_of(image), **options)
    expected = np.zeros((2, 18, 18), int)
    expected[1, :, middle - 8 : middle - 5] = most = int(np.floor(np.log(1 / BLACK) / threshold))
    np.testing.assert_array_equal(signed(events)[:, inside, inside], expected)
    # The edge enters a column when it leaves the one before.
    kept = (events.y >= 8) & (events.y < 26)
    starts = [events.t[kept & (events.x == column)].min() for column in range(middle, middle + 3)]
    assert starts == sorted(starts)
    for changes in ({"flipped": True}, {"negative": True}):
        (other,) = record(conditions_of(image), **options | changes)
        np.testing.assert_array_equal(signed(other)[:, inside, inside], expected[::-1], str(changes))
    assert most > 5


def test_the_measured_sign_is_that_of_the_trailing_edge():
    """As in N-MNIST: a bright bar that moves right shows p = 1 behind, where the negative's light comes back."""
    image = np.zeros((1, SIDE, SIDE))
    image[:, :, 12:16] = 255
    options = STILL | {"negative": True, "path_us": (0, 100_000), "path_px": ((0, 0), (4, 0))}
    (events,) = record(conditions_of(image), **options)
    inside = (events.y >= 8) & (events.y < 26)
    assert events.x[inside & (events.p == 1)].mean() < events.x[inside & (events.p == 0)].mean() - 3


@pytest.mark.parametrize("blur_px", [0.0, 0.5])
def test_panned_pictures_are_exact_means(blur_px):
    rng = np.random.default_rng(0)
    picture, side = rng.random((6, 6)), 6.0
    seen = pan(picture, 0.3, side, (10, 8), np.array([[5.0, 4.0], [6.0, 4.0], [5.5, 4.0]]), blur_px)
    assert seen.shape == (3, 8, 10) and seen.dtype == np.float32
    np.testing.assert_allclose(seen.sum(axis=(1, 2)), (picture - 0.3).sum() + 0.3 * 80, rtol=1e-5)
    np.testing.assert_allclose(seen[1, :, 3:], seen[0, :, 2:-1], atol=1e-6)
    if blur_px == 0:
        np.testing.assert_allclose(seen[0, 1:7, 2:8], picture, atol=1e-6)
        np.testing.assert_allclose(seen[2, 1:7, 3:8], (picture[:, :-1] + picture[:, 1:]) / 2, atol=1e-6)
    assert abs(seen[0, 0, 0] - 0.3) < 1e-6 or blur_px


@pytest.mark.slow
def test_calibration_finds_what_made_the_recordings():
    """Thresholds within 5 %, the leak within a quarter, the place (of other pictures) within 0.7 px."""
    made_with = {
        "threshold": 0.34, "threshold_off": 0.4, "leak_rate_hz": 1.0, "shot_noise_rate_hz": 0.4, "refractory_us": 2500,
        "centre_px": (-1.5, -2.0), "picture_share": 26 / 34, "negative": True, "flipped": False,
        "hot_pixels": ((2, 3, 40.0),),
    }  # fmt: skip
    recordings = record(strokes(12, seed=1), **made_with)
    names = ["ab"[number % 2] for number in range(12)]
    found, measured = calibrate(iter(recordings), names, strokes(40, seed=2), SampleOptions())
    assert found.threshold == pytest.approx(0.34, rel=0.05) and found.threshold_off == pytest.approx(0.4, rel=0.05)
    assert found.negative is True and found.flipped is False
    assert found.refractory_us == pytest.approx(2500, rel=0.1)
    assert found.leak_rate_hz == pytest.approx(1.0, rel=0.25) and found.shot_noise_rate_hz == pytest.approx(
        0.4, rel=0.3
    )
    np.testing.assert_allclose(found.centre_px or (), (-1.5, -2.0), atol=0.7)
    assert found.picture_share == pytest.approx(26 / 34, rel=0.05)
    assert [(x, y) for x, y, _ in found.hot_pixels or ()] == [(2, 3)]
    assert measured["recordings"] == 12 and measured["agreement_of_motion"] > 0.9
    again, _ = calibrate(iter(recordings), names, strokes(40, seed=2), SampleOptions())
    assert again == found


def test_calibration_tells_a_camera_that_calls_falling_light_1():
    recordings = record(strokes(12, seed=1), flipped=True, negative=False, leak_rate_hz=1.0)
    found, _ = calibrate(recordings, ["ab"[n % 2] for n in range(12)], strokes(20, seed=2), SampleOptions())
    assert (found.flipped, found.negative) == (True, False)


@pytest.mark.slow
def test_what_the_user_sets_wins_and_two_recordings_are_enough():
    recordings = record(strokes(2, seed=1), threshold=0.3)
    given = {"threshold": 0.7, "centre_px": (1.0, 1.0), "negative": False, "leak_rate_hz": 0.0}
    found, _ = calibrate(recordings, ["a", "b"], strokes(6), SampleOptions(**given))
    assert {name: getattr(found, name) for name in given} == given
    assert all(getattr(found, name) is not None for name in UNCALIBRATED)


def test_wrong_input_is_named():
    asked = strokes(2)
    with pytest.raises(ValueError, match="needs pictures; use condition 'picture'"):
        record(Conditions(("", "")))
    with pytest.raises(ValueError, match="2 conditions, 2 pictures and 1 seeds"):
        record(asked, [0])
    assert asked.images is not None
    with pytest.raises(ValueError, match=r"pictures must be \[N, S, S, 3\] uint8"):
        record(Conditions(("",), asked.images[:1, :20]))
    with pytest.raises(ValueError, match="sensor_size"):
        record(asked, size=(0, 3))
    with pytest.raises(DataError, match="generator 'picture_simulator', row 1: sensor: more than max_events"):
        record(conditions_of([np.zeros((SIDE, SIDE)), asked.images[0, ..., 0]]), max_events=200, leak_rate_hz=0.0)
    assert issubclass(EventBudgetError, DataError)
    for wrong in ({"path_us": (0,), "path_px": ((0, 0),)}, {"path_us": (0, 5)}, {"threshold": 0}, {"black": 1}):
        with pytest.raises(ValueError):
            SampleOptions(**wrong)
    with pytest.raises(ValueError, match="ascend from 0"):
        SampleOptions(path_us=(0, 5, 5), path_px=((0, 0),) * 3)
    with pytest.raises(DataError, match="no recording has events"):
        calibrate([], [], asked, SampleOptions())
    other = record(asked.take(np.array([0])), size=(40, 34))
    with pytest.raises(DataError, match="sensors differ in size"):
        calibrate(record(asked) + other, ["a", "b", "a"], asked, SampleOptions())


def test_larger_sensors_keep_the_frames_of_a_block_only(monkeypatch):
    (whole,) = record(strokes(1), size=(60, 50))
    monkeypatch.setattr(picture_simulator, "BLOCK_VALUES", 60 * 50 * 3)
    assert same(record(strokes(1), size=(60, 50))[0], whole)


@pytest.mark.skipif(not (REAL / "nmnist").is_dir(), reason="no real recordings beside this checkout")
def test_calibrated_on_two_recordings_a_class_counts_are_those_of_others():
    """Events a recording within 15 %, polarities within 0.03, of recordings that were not calibrated with."""
    from ctlev_core.conditions import picture
    from data_contracts.labels import Labels

    classes = ("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
    files = {name: sorted((REAL / "nmnist" / name).glob("*.bin"))[:10] for name in classes}
    names = [name for name in classes for _ in range(2)]
    known = [event_files.read_events_file(file) for name in classes for file in files[name][:2]]
    options = picture.Options(root=REAL / "mnist_images" / "digits.npz", class_names=classes)
    labels = Labels(classes * 5, np.zeros(50, np.int64))
    shown = picture.render(labels, SIZE, options, range(50))
    asked = Conditions(shown.prompts, shown.images, None, labels.class_names)
    found, measured = calibrate(known, names, asked, SampleOptions())
    assert (found.negative, found.flipped) == (True, False) and measured["agreement_of_motion"] > 0.97
    made = list(sample_events(asked, SIZE, found, seeds=range(50)))
    real = [event_files.read_events_file(file) for name in classes for file in files[name][2:7]]
    count_made, count_real = (np.mean([len(events) for events in some]) for some in (made, real))
    assert count_made == pytest.approx(count_real, rel=0.15)
    share_made, share_real = (np.mean([events.p.mean() for events in some]) for some in (made, real))
    assert share_made == pytest.approx(share_real, abs=0.03)
