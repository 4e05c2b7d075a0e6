"""The text route on real recordings: the published counts, and the whole chain."""

import pytest
from flow_scripts import REAL_RECORDINGS, run_script_here

from data_contracts.manifest import ManifestRef, read_manifest

# From the published table of these files: events, duration, ON, OFF.
PUBLISHED = {
    "person": (111_954, 589_917, 55_023, 56_931, (320, 240)),
    "spot": (539_481, 50_000, 367_855, 171_626, (640, 480)),
    "street": (219_596, 8_801, 115_532, 104_064, (1280, 720)),
}
SMALL = (
    "--set", "generator.options.num_steps=6",
    "--set", "num_synthetic=6",
    "--set", "sampling.num_inference_steps=4",
    "--set", "windows.max_windows=12",
    "--set", "downstream.options.num_steps=10",
    "--set", "feature_extractor.options.num_steps=10",
)  # fmt: skip


@pytest.fixture(scope="module")
def finished_home(tmp_path_factory, request):
    if not REAL_RECORDINGS.is_dir():
        pytest.skip("the real recordings are not beside this checkout")
    home = tmp_path_factory.mktemp("folder")
    finished = run_script_here(
        "full_experiment", "--preset", "folder", "--set", f"dataset.options.root={REAL_RECORDINGS}", *SMALL, home=home
    )
    assert finished.status == 0, finished.errors
    return home


def only(home, stage):
    (folder,) = (home / "artefacts" / stage).iterdir()
    return read_manifest(ManifestRef(key=folder.name, path=folder))


def test_recordings_manifest_equals_the_published_counts(finished_home):
    rows = {row["class_name"]: row for row in only(finished_home, "ingest").table.to_pylist()}
    assert {
        name: (
            row["num_events"], row["duration_us"], row["num_positive"], row["num_negative"],
            (row["sensor_width_px"], row["sensor_height_px"]),
        )
        for name, row in rows.items()
    } == PUBLISHED  # fmt: skip
    assert (rows["street"]["t_first_us"], rows["street"]["t_last_us"]) == (11_718_656, 11_727_457)
    assert (rows["spot"]["t_first_us"], rows["spot"]["t_last_us"]) == (1_317_888, 1_367_888)
    assert {row["splits"] for row in rows.values()} == {"train+test"}


def test_training_windows_come_before_test_windows(finished_home):
    frames = only(finished_home, "encode").table.to_pylist()
    for name in PUBLISHED:
        learnt = [row["t_end_us"] for row in frames if row["class_name"] == name and row["split"] == "train"]
        tested = [row["t_start_us"] for row in frames if row["class_name"] == name and row["split"] == "test"]
        assert learnt and tested and max(learnt) <= min(tested)


def test_synthetic_frames_carry_their_class(finished_home):
    rows = only(finished_home, "sample").table.to_pylist()
    assert [row["class_name"] for row in rows] == ["person", "spot", "street"] * 2
    assert all(row["prompt"] == f"A photo of {row['class_name']}" for row in rows)
