"""N-MNIST: both layouts become fixed splits, draws are nested, and every bad tree is one error that says where."""

import struct
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from ctlev_core.datasets import nmnist
from ctlev_core.events.windows import time_bins
from data_contracts.errors import DataError

REAL = Path(__file__).resolve().parents[3].parent / "shared" / "real" / "nmnist"
COUNT = 20


def write_recording(path: Path, seed: int = 0, num_events: int = 90, largest: int = 34) -> Path:
    """40 bits an event, as N-MNIST's authors describe them: x, y, polarity and 23 bits of time."""
    random = np.random.default_rng(seed)
    t = np.sort(random.integers(0, 300_000, num_events)).tolist()
    x, y = random.integers(0, largest, (2, num_events)).tolist()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"".join(struct.pack(">BBBH", a, b, c >> 16, c & 0xFFFF) for a, b, c in zip(x, y, t, strict=True)))
    return path


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for name in ("zero", "one", "seven"):
        for number in range(1, COUNT + 1):
            write_recording(tmp_path / "n" / name / f"{number:05d}.bin", number)
    (tmp_path / "n" / "README.md").write_text("about")
    return tmp_path / "n"


def listed(root, **options):
    return nmnist.list_recordings(nmnist.Options(root=root, **options))


def names_of(recordings, split):
    return [recording.recording_id for recording in recordings if recording.parts[0].split == split]


def test_splits_are_by_number_and_cover_each_class(root):
    recordings = listed(root)
    # 20 a class: round(.43 * 20) = 9 tested, round(.15 * 20) = 3 for validation.
    assert names_of(recordings, "train") == [f"{c}/{n:05d}" for c in ("zero", "one", "seven") for n in range(1, 9)]
    assert names_of(recordings, "test") == [f"{c}/{n:05d}" for c in ("zero", "one", "seven") for n in range(12, 21)]
    assert names_of(listed(root, tested="validation"), "test") == [
        f"{c}/{n:05d}" for c in ("zero", "one", "seven") for n in range(9, 12)
    ]
    assert names_of(recordings, "condition") == ["condition/zero", "condition/one", "condition/seven"]


def test_draws_are_nested_and_differ(root):
    few, more = (names_of(listed(root, recordings_per_class=k), "train") for k in (2, 5))
    assert len(few) == 6 and len(more) == 15 and set(few) < set(more)
    other = names_of(listed(root, recordings_per_class=2, draw=1), "train")
    assert set(other) != set(few)
    rest = names_of(listed(root, recordings_per_class=5, learn_from="rest"), "train")
    assert set(rest) | set(more) == set(names_of(listed(root), "train")) and not set(rest) & set(more)


def test_published_layout_has_its_own_test_split(tmp_path):
    for part, count in (("Train", 10), ("Test", 4)):
        for folder in ("0", "3"):
            for number in range(1, count + 1):
                write_recording(tmp_path / part / folder / f"{number:05d}.bin", number)
    recordings = listed(tmp_path)
    assert {recording.class_name for recording in recordings} == {"zero", "three"}
    assert len(names_of(recordings, "test")) == 8 and names_of(recordings, "test")[0] == "Test/0/00001"
    assert len(names_of(recordings, "train")) == 2 * (10 - 2)


def test_other_recordings_are_tested_in_place_of_the_roots_own(root, tmp_path):
    for folder in ("0", "7", "9"):
        write_recording(tmp_path / "other" / folder / "00001.bin")
    recordings = listed(root, test_root=tmp_path / "other")
    assert names_of(recordings, "test") == ["test_root/0/00001", "test_root/7/00001"]
    assert names_of(recordings, "train") == names_of(listed(root), "train"), "the root's test recordings stay unread"


def test_unseen_classes_are_tested_and_never_learnt_from(root):
    recordings = listed(root, unseen=["seven"])
    assert {name.partition("/")[0] for name in names_of(recordings, "train")} == {"zero", "one"}
    assert {name.partition("/")[0] for name in names_of(recordings, "test")} == {"zero", "one", "seven"}
    assert "condition/seven" in names_of(recordings, "condition")


def test_windows_are_the_three_saccades(root):
    (recording, *_) = listed(root)
    options = nmnist.Options(root=root)
    events = nmnist.read_events(recording, options)
    ranges = nmnist.read_windows(recording, options)
    assert ranges.shape == (3, 2) and ranges[0, 0] == 0 and ranges[-1, 1] == len(events)
    third = (events.t[-1] - events.t[0] + 1) / 3
    for number, (start, stop) in enumerate(ranges):
        inside = events.t[start:stop] - events.t[0]
        assert inside.min() >= number * third - 1 and inside.max() < (number + 1) * third
    assert np.array_equal(ranges, time_bins(events.t, np.array([[0, len(events)]]), 3)[0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"recordings_per_class": 9}, "recordings_per_class is 9, and class 'zero' has 8 to learn from"),
        ({"classes": ["zero", "two"]}, "no recordings of class 'two'; there are: zero, one, seven"),
        ({"unseen": ["nine"]}, "no recordings of class 'nine'"),
    ],
)
def test_what_is_not_there_is_said(root, options, message):
    with pytest.raises(DataError, match=message):
        listed(root, **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"classes": ["ten"]}, "expected different ones of zero"),
        ({"learn_from": "rest"}, "learn_from=rest needs recordings_per_class"),
        ({"test_fraction": 0.9}, "leave nothing to learn from"),
    ],
)
def test_options_that_do_not_go_together(root, options, message):
    with pytest.raises(ValidationError, match=message):
        nmnist.Options(root=root, **options)


def test_bad_trees(root, tmp_path):
    with pytest.raises(DataError, match="no such folder"):
        listed(tmp_path / "none")
    with pytest.raises(DataError, match="the root is"):
        listed(tmp_path)
    (root / "eight").mkdir()
    with pytest.raises(DataError, match=r"eight: expected \*.bin files, found none"):
        listed(root)
    write_recording(root / "eight" / "00001.bin")
    with pytest.raises(DataError, match="1 recordings of class 'eight' are too few for the splits"):
        listed(root)
    (root / "eight").rename(root / "0")
    with pytest.raises(DataError, match="a second folder of class 'zero'"):
        listed(root)


def test_bad_recordings(root):
    options = nmnist.Options(root=root)
    (first, *_) = nmnist.list_recordings(options)
    (file,) = first.files
    whole = file.read_bytes()
    for content in (b"", whole[:-2]):
        file.write_bytes(content)
        with pytest.raises(DataError, match=r"00001\.bin"):
            nmnist.read_events(first, options)
    write_recording(file, largest=200)
    with pytest.raises(DataError, match="expected a recording of 34 x 34 px"):
        nmnist.read_events(first, options)


def test_real_recordings():
    if not REAL.is_dir():
        pytest.skip("the real N-MNIST recordings are not beside this checkout")
    recordings = listed(REAL)
    assert len(names_of(recordings, "test")) >= 300
    assert len(names_of(recordings, "train")) + len(names_of(recordings, "test")) < 700
    options = nmnist.Options(root=REAL)
    first = recordings[0]
    events = nmnist.read_events(first, options)
    assert events.sensor_size == (34, 34) and 1000 < len(events) < 12_000
    assert all(stop > start for start, stop in nmnist.read_windows(first, options))


def test_polarity_against_the_direction_of_the_saccades():
    """A bright digit on a dark screen darkens pixels where it has been: p = 1 are the events on that side.

    Other ATIS files call brighter events 1 (Orchard et al. say ON); in N-MNIST's released files, which are of a
    stabilised image, it is the other way about. The simulator's calibration relies on it.
    """
    if not REAL.is_dir():
        pytest.skip("the real N-MNIST recordings are not beside this checkout")
    options = nmnist.Options(root=REAL)
    offsets_px = []
    for recording in [recording for recording in listed(REAL) if recording.has_events][::14]:
        events = nmnist.read_events(recording, options)
        for start, stop in nmnist.read_windows(recording, options):
            rows = slice(start, stop)
            place, polarity = np.stack([events.x[rows], events.y[rows]], 1).astype(float), events.p[rows] > 0
            time = events.t[rows] - events.t[rows].mean()
            direction = time @ (place - place.mean(axis=0))
            direction /= np.linalg.norm(direction)
            # In slices of time, so that the motion itself does not part the polarities.
            of_slices = [
                place[part][polarity[part]].mean(axis=0) - place[part][~polarity[part]].mean(axis=0)
                for part in np.array_split(np.arange(len(place)), 8)
                if 5 < polarity[part].sum() < len(part) - 5
            ]
            offsets_px.append(np.mean(of_slices, axis=0) @ direction)
    assert len(offsets_px) > 100
    assert (np.array(offsets_px) < 0).all()
    assert -5 < np.mean(offsets_px) < -3
