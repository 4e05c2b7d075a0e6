"""Options are chosen on validation recordings, with which nothing of the test recordings is looked at."""

import json

import pyarrow.parquet as pq
import pytest
from flow_scripts import artefacts, run_script_here

SETTINGS = (
    "evaluate_on=validation", "dataset.options.num_validation_recordings=5", "baselines={}", "oracle=null",
    "training_sets=[recorded]", "scaling=[]", "keep_fraction=null",
)  # fmt: skip


@pytest.mark.slow
def test_smoke_is_scored_on_validation_recordings(tmp_path):
    options = [word for setting in SETTINGS for word in ("--set", setting)]
    finished = run_script_here("full_experiment", "--preset", "smoke", *options, home=tmp_path)
    assert finished.status == 0, finished.errors
    (frames,) = (made for made in artefacts(tmp_path, "encode") if "validation" in made.column("split"))
    assert set(frames.column("split")) == {"train", "validation"}
    (score, *_) = pq.read_table(tmp_path / "reports" / "smoke" / "scores.parquet").to_pylist()
    assert score["num_samples"] == len(frames.rows_where(split="validation"))
    page = (tmp_path / "reports" / "smoke.html").read_text()
    assert "Scored on validation recordings; nothing of the test recordings was looked at." in page
    assert not (tmp_path / "test_sets").exists()


def test_a_run_on_test_recordings_is_noted(smoke_home):
    noted = [
        [json.loads(line) for line in file.read_text().splitlines()] for file in (smoke_home / "test_sets").iterdir()
    ]
    assert any(lines[0]["experiment"] == "smoke" for lines in noted)
    page = (smoke_home / "reports" / "smoke.html").read_text()
    assert "the first experiment in this store to be scored on these test frames" in page
