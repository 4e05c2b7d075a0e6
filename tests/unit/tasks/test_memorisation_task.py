"""The stage that looks for copies: rows of the generator, and of held-out frames as the floor."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from ctlev_core.scoring.memorisation import check_memorisation, small_pictures
from data_contracts import tables
from data_contracts.labels import Labels
from data_contracts.manifest import label_columns, read_manifest, write_manifest
from tasks.memorisation import memorisation
from tasks.stage import Output


def write(folder, images, recordings, splits):
    folder.mkdir()
    np.save(folder / "frames.npy", images)
    count = len(images)
    columns = {
        "sample_id": [f"{folder.name}/{row}" for row in range(count)],
        "recording_id": list(recordings),
        "subject": list(recordings),
        "split": list(splits),
        "class_name": ["walk"] * count,
        **dict.fromkeys(("t_start_us", "t_end_us", "t_us", "num_events"), pa.array([1] * count, pa.int64())),
        **label_columns(Labels(("walk",) * count, np.zeros(count, np.int64))),
    }
    return read_manifest(write_manifest(folder, pa.table(columns), tables.FRAMES))


def pictures(seed, count):
    return np.random.default_rng(seed).integers(0, 256, (count, 8, 8, 3), np.uint8)


def search(tmp_path, splits, made):
    recordings = np.repeat([f"r{number}" for number in range(len(splits))], 30)
    frames = write(tmp_path / "frames", pictures(0, len(recordings)), recordings, np.repeat(splits, 30))
    generated = write(tmp_path / "made", made(frames), [f"m{n}" for n in range(40)], ["train"] * 40)
    (tmp_path / "out").mkdir()
    table = memorisation.function(
        Output(tmp_path / "out", tmp_path), frames, generated, None, downstream=None, subject="synthetic"
    )
    return frames, {(row["subject"], row["metric"]): row for row in table.to_pylist()}


def test_held_out_frames_are_scored_as_generated_ones_are(tmp_path):
    copies = lambda frames: np.array(frames.array("frames")[:40])  # noqa: E731
    frames, found = search(tmp_path, ["train"] * 4 + ["test"] * 3, copies)
    recordings = np.array(frames.column("recording_id"))
    features = [small_pictures(frames.images(np.flatnonzero(rows))) for rows in (recordings < "r4", recordings >= "r4")]
    learnt = recordings[recordings < "r4"]
    expected = check_memorisation(
        features[1],
        features[0],
        features[0],
        training_recordings=learnt,
        real_recordings=learnt,
        generated_recordings=recordings[recordings >= "r4"],
    )
    floor, copied = found["held-out recorded", "data_copying_z"], found["synthetic", "data_copying_z"]
    assert (floor["value"], floor["low"], floor["high"]) == (
        expected.copying.value, expected.copying.low, expected.copying.high
    )  # fmt: skip
    assert floor["num_samples"] == 90 and copied["num_samples"] == 40 and floor["num_train"] == 120
    assert copied["value"] < -5 < floor["value"]
    assert found["held-out recorded", "authentic_share"]["value"] == expected.authentic_share
    assert found["synthetic", "authentic_share"]["value"] == 0
    assert {metric for subject, metric in found if subject == "synthetic"} == {
        "close_share", "duplicates", "nearest_distance_ratio", "data_copying_z", "authentic_share",
    }  # fmt: skip


@pytest.mark.parametrize("splits", [["train"] * 3, ["train", "test"]])
def test_without_held_out_frames_or_other_recordings_what_can_be_scored_is(tmp_path, splits):
    _, found = search(tmp_path, splits, lambda frames: pictures(1, 40))
    assert ("synthetic", "data_copying_z") in found and found["synthetic", "close_share"]["num_samples"] == 40
    assert (("held-out recorded", "close_share") in found) == ("test" in splits)


@pytest.mark.parametrize("others", [0, 10])
def test_held_out_frames_of_the_only_training_recording_are_not_compared_with_it(tmp_path, others):
    """As where one recording is split in time: its frames resemble their neighbours without being copied."""
    recordings, splits = ["r0"] * 60 + ["r1"] * others, ["train"] * 40 + ["test"] * (20 + others)
    frames = write(tmp_path / "frames", pictures(0, 60 + others), recordings, splits)
    made = write(tmp_path / "made", pictures(1, 40), [f"m{n}" for n in range(40)], ["train"] * 40)
    (tmp_path / "out").mkdir()
    out = Output(tmp_path / "out", tmp_path)
    table = memorisation.function(out, frames, made, None, downstream=None, subject="synthetic")
    counts = {row["subject"]: row["num_samples"] for row in table.to_pylist()}
    assert counts == ({"synthetic": 40, "held-out recorded": others} if others else {})
