"""Recordings and labels without stretches of `sequence_length` frames are refused before anything is learnt."""

import re

import pytest
from flow_scripts import run_script_here

IN_TIME = ("temporal_order=true", "windows={method: duration, duration_us: 20000}")
SMALL = (
    "dataset.options={num_train_recordings: 2, num_test_recordings: 1, num_condition_recordings: 2, "
    "recording_duration_us: 100000}",
    "baselines={}", "oracle=null", "scaling=[]", "keep_fraction=null", "mixtures=[]", "export=null",
)  # fmt: skip


@pytest.mark.parametrize(
    ("length", "condition_rate_hz", "told"),
    [(8, 50, "has so many training frames"), (3, 200, "labels to sample from")],
)
def test_too_short_recordings_and_labels_are_refused_before_anything_is_learnt(
    tmp_path, length, condition_rate_hz, told
):
    options = (
        *IN_TIME, *SMALL, f"sequence_length={length}", f"dataset.options.condition_rate_hz={condition_rate_hz}",
        "num_synthetic=42",
    )  # fmt: skip
    asked = [word for option in options for word in ("--set", option)]
    finished = run_script_here("full_experiment", "--preset", "smoke", *asked, home=tmp_path)
    assert finished.status == 2
    assert re.search(f"sequence_length: expected {length} frames in a row.*{told}", finished.errors), finished.errors
    made = {folder.name for folder in (tmp_path / "artefacts").iterdir()}
    assert "encode" in made and "finetune" not in made and "sample" not in made
