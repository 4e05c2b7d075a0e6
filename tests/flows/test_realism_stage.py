"""The realism stage and its sections in the report of a finished smoke run."""

from __future__ import annotations

import numpy as np
import pyarrow.parquet as pq
from flow_scripts import artefacts

from ctlev_core.realism.distances import DISTRIBUTIONS
from ctlev_core.realism.summary import summarise_frames
from data_contracts.tables import TWO_SAMPLE_TESTS


def realism_rows(home):
    return [
        row for stage in ("event_realism", "realism") for one in artefacts(home, stage) for row in one.table.to_pylist()
    ]


def test_the_report_sets_synthetic_beside_real(smoke_home):
    page = (smoke_home / "reports" / "smoke.html").read_text()
    for expected in (
        "How real do the synthetic frames look?", "How alike are the recordings?", "noise_rate_hz",
        "Can a network tell synthetic from recorded frames?", "fewer than 40 frames in a set", "isolated_pixel_share",
        "Power spectrum",
    ):  # fmt: skip
        assert expected in page
    published = pq.read_table(smoke_home / "reports" / "smoke" / "realism.parquet")
    assert sorted(published.to_pylist(), key=str) == sorted(realism_rows(smoke_home), key=str)


def test_numbers_are_those_of_the_frames_that_were_sampled(smoke_home):
    found = {(row["group"], row["subject"], row["metric"]): row for row in realism_rows(smoke_home)}
    (synthetic,) = artefacts(smoke_home, "sample", "generators/controlnet")
    shares = [summarise_frames(frame[None]).numbers["active_pixel_share"] for frame in synthetic.array("frames")]
    row = found["frames", "synthetic", "active_pixel_share"]
    np.testing.assert_allclose(row["value"], np.mean(shares))
    assert row["num_samples"] == len(synthetic) and row["low"] <= row["value"] <= row["high"]
    assert found["events", "train", "noise_rate_hz"]["num_samples"] == 8
    for setting in ("synthetic against recorded", "recorded against recorded"):
        assert 0 <= found["frames", setting, "value_js_bits"]["value"] <= 1


def test_generator_and_baselines_are_told_from_recorded_frames_or_it_says_why_not(smoke_home):
    (floors,) = artefacts(smoke_home, "realism_floors")
    of_generators = [one.attached(TWO_SAMPLE_TESTS) for one in artefacts(smoke_home, "realism")]
    tests = [test for table in (floors.table, *of_generators) for test in table.to_pylist()]
    names = ("synthetic", "event_gan", "smpl_esim")
    expected = {f"{name} against {other}" for name in names for other in ("recorded", "test")}
    assert {test["subject"] for test in tests} == expected | {
        "recorded against recorded",
        "test against test",
        "test against recorded",
    }
    assert all(test["value"] is None and test["note"] for test in tests), "smoke has too few frames for any"


def test_distributions_add_up_to_1(smoke_home):
    made = [one for stage in ("event_realism", "realism") for one in artefacts(smoke_home, stage)]
    table = [row for one in made for row in one.attached(DISTRIBUTIONS).to_pylist()]
    sums: dict[tuple, float] = {}
    for row in table:
        key = (row["group"], row["subject"], row["axis"])
        sums[key] = sums.get(key, 0) + row["share"]
    assert {("events", "train", "interval"), ("events", "test", "pixel_rate"), ("frames", "recorded", "value")} <= set(
        sums
    )
    assert ("frames", "synthetic", "power_spectrum") in sums
    np.testing.assert_allclose(list(sums.values()), 1)
