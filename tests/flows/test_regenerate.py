"""Versions of synthetic data: made one after another, judged, published, made again, gone on with, kept.

All but the last test call the flow's wiring in this process, without Prefect, on the smallest data there is.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flow_scripts import digests, run_script, script

from data_contracts.errors import DataError
from data_contracts.manifest import ManifestRef, read_manifest
from data_contracts.published import Version, latest_frames, published_folder, read_latest, read_versions
from tasks.stage import in_one_run, planning
from tasks.store import Store

GATES = ("max_distance_ratio", "max_label_error_ratio", "max_memorised_share", "max_rejected_share")
OPTIONS = (
    "num_synthetic=3", "baselines={}", "oracle=null", "max_attempts=2", "generator.options.num_steps=2",
    "sampling.num_inference_steps=2", "downstream.options.num_steps=2", "feature_extractor.options.num_steps=2",
    # Nothing learnt in two steps is good; what is tested is what follows from that.
    "gates.max_distance_ratio=1.0e+6", "gates.max_label_error_ratio=1.0e+6", "gates.max_memorised_share=1",
    "gates.max_rejected_share=1",
)  # fmt: skip
UNKEEPABLE = "gates.max_distance_ratio=1.0e-6"


def make_next(patch: pytest.MonkeyPatch, home: Path, *overrides: str) -> Any:
    """Make the next version under a home, as the flow does; stages run here rather than as tasks of Prefect."""
    patch.setattr("tasks.stage.run_as_task", lambda name, label, work: work()[0])
    patch.setenv("CTLEV_HOME", str(home))
    from flows import regenerate  # here, because flows take the home from the environment

    with in_one_run():
        return regenerate.make_next_version(regenerate.load_regeneration("smoke", [*OPTIONS, *overrides]))


@pytest.fixture
def make_version(monkeypatch):
    return partial(make_next, monkeypatch)


@pytest.fixture(scope="module")
def first_home(tmp_path_factory):
    """A home with one published version, to be copied."""
    home = tmp_path_factory.mktemp("regeneration") / "home"
    with pytest.MonkeyPatch.context() as patch:
        assert make_next(patch, home).passed
    return home


@pytest.fixture
def home(first_home, tmp_path):
    return Path(shutil.copytree(first_home, tmp_path / "home"))


def folder_of(home: Path) -> Path:
    return published_folder(home, "smoke")


def frames_of(home: Path, version: Version) -> np.ndarray:
    found = version.synthetic
    ref = ManifestRef(key=found.key, path=home / "artefacts" / found.stage / found.key, digest=found.digest)
    return np.asarray(read_manifest(ref, full=True).array("frames"))


def test_versions_differ_and_can_be_made_again(home, make_version, tmp_path):
    second = make_version(home)
    first, *others = read_versions(folder_of(home))
    assert others == [second] and second.number == 2 and read_latest(folder_of(home)) == second
    assert first.seed != second.seed and first.made_from[0] == second.made_from[0], "one generator, other noise"
    assert first.made_from[1] != second.made_from[1], "other poses"
    assert not np.array_equal(frames_of(home, first), frames_of(home, second))
    opened = read_manifest(latest_frames(home, "smoke"))
    assert opened.ref.digest == second.synthetic.digest and len(opened) == 3
    assert second.scores["rejected"] == sum(bool(cause) for cause in opened.column("rejected"))
    measured = {name.split("_")[0] for name in second.scores if name.startswith("synthetic, all: ")}
    assert measured == {"synthetic, all: fd", "synthetic, all: kid", "synthetic, all: mmd"}

    # Somewhere else, from the first version alone, the second comes out the same.
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(home, elsewhere)
    (folder_of(elsewhere) / "v0002.json").unlink()
    shutil.copy(folder_of(elsewhere) / "v0001.json", folder_of(elsewhere) / "latest.json")
    for artefact in (second.synthetic, *second.made_from[1:], *second.scored_in):
        if artefact not in first.artefacts:
            shutil.rmtree(elsewhere / "artefacts" / artefact.stage / artefact.key)
    again = make_version(elsewhere)
    assert again.model_dump(exclude={"made"}) == second.model_dump(exclude={"made"})


@pytest.mark.parametrize("decoder", [[], ["pixel_decoder={num_passes: 2}"]])
def test_versions_are_sampled_as_the_experiments_own_frames_are(monkeypatch, tmp_path, decoder):
    """What the experiment heeds of sampling the versions heed: the plans differ in seed and label alone."""
    monkeypatch.setenv("CTLEV_HOME", str(tmp_path))
    from flows import full_experiment, regenerate, sampling
    from flows.command_line import load_experiment

    asked, decoded = [], []

    def noting(made, noted):
        def call(*inputs, **settings):
            noted.append(settings)
            return made(*inputs, **settings)

        return call

    monkeypatch.setattr(sampling, "sample", noting(sampling.sample, asked))
    monkeypatch.setattr(sampling, "decode_pixels", noting(sampling.decode_pixels, decoded))
    options = ["baselines={}", "oracle=null", "stochastic_rounding=true", "max_attempts=3", *decoder]
    with planning():
        regenerate.make_next_version(regenerate.load_regeneration("smoke", options))
        full_experiment.full_experiment.fn(load_experiment("smoke", options))
    own = [{name: value for name, value in named.items() if name not in ("seed", "label")} for named in asked]
    assert own[0] == own[1] and (own[0]["rounding"] is None) == bool(decoder)
    assert len(decoded) == 2 * len(decoder) and all(one["options"].num_passes == 2 for one in decoded)


def test_without_new_poses_only_the_noise_is_new(home, make_version):
    second = make_version(home, "new_poses=false")
    third = make_version(home, "new_poses=false")
    assert second.made_from == third.made_from and second.synthetic.digest != third.synthetic.digest


def test_a_version_that_breaks_a_gate_is_recorded_and_the_latest_stays(home, make_version):
    first = read_latest(folder_of(home))
    refused = make_version(home, UNKEEPABLE)
    assert not refused.passed and read_latest(folder_of(home)) == first
    assert [version.passed for version in read_versions(folder_of(home))] == [True, False]
    (broken,) = [check for check in refused.checks if not check.passed]
    assert broken.gate == "max_distance_ratio" and broken.value > broken.limit > 0
    assert "version 2 of smoke was rejected: max_distance_ratio: Frechet distance" in str(refused)
    third = make_version(home)
    assert third.number == 3 and third.passed and read_latest(folder_of(home)) == third


def test_what_no_gate_asks_for_is_not_scored(home, make_version):
    version = make_version(home, *(f"gates.{name}=null" for name in GATES))
    assert version.passed and version.checks == ()
    assert {artefact.stage for artefact in version.scored_in} == {"score_beside_real", "memorisation"}


def test_statistics_of_the_frames_can_be_gates(home, make_version):
    limits = "gates.max_realism_distances={active_pixel_share: 1, isolated_pixel_share: 1}"
    version = make_version(home, limits)
    checks = [check for check in version.checks if check.gate == "max_realism_distances"]
    assert [check.score for check in checks] == [
        "active_pixel_share against recorded",
        "isolated_pixel_share against recorded",
    ]
    assert all(check.passed for check in checks)
    assert "realism" in {artefact.stage for artefact in version.scored_in}
    assert version.scores["synthetic against recorded, frames: active_pixel_share"] == checks[0].value
    with pytest.raises(DataError, match="max_c2st: needs num_synthetic of 40 or more, got 3"):
        make_version(home, "gates.max_c2st=0.9")


def test_an_interrupted_version_goes_on_from_its_samples(home, make_version, monkeypatch):
    from flows import regenerate

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(regenerate, "_judge", interrupted)
        make_version(home)
    (first,) = read_versions(folder_of(home))
    assert read_latest(folder_of(home)) == first
    before = {path: path.stat().st_mtime_ns for path in home.glob("artefacts/*/*/manifest.parquet")}
    second = make_version(home)
    assert second.number == 2 and read_latest(folder_of(home)) == second
    assert {path: path.stat().st_mtime_ns for path in home.glob("artefacts/*/*/manifest.parquet")} == before


def test_a_plan_names_the_stages_of_the_next_version_and_claims_nothing(home, make_version):
    before = sorted(folder_of(home).iterdir())
    with planning() as rows:
        assert make_version(home) is None
    assert sorted(folder_of(home).iterdir()) == before
    planned = {row.stage: row for row in rows if not row.cached}
    assert set(planned) == {"condition_samples", "sample", "score_beside_real", "memorisation", "score_model"}
    assert planned["sample"].key == make_version(home).synthetic.key


def test_pruning_keeps_what_the_versions_that_are_kept_refer_to(home, make_version, tmp_path):
    make_version(home, UNKEEPABLE)
    make_version(home)
    copy = Path(shutil.copytree(home, tmp_path / "copy"))  # which no process uses
    first, refused, third = read_versions(folder_of(copy))
    for record in copy.glob("artefacts/*/*/run.json"):
        os.utime(record, (0, 0))
    store = Store(copy)

    def stays(version: Version) -> bool:
        return all((copy / "artefacts" / a.stage / a.key).is_dir() for a in version.artefacts)

    assert stays(first) and stays(refused)
    store.prune(1, keep_versions=2)
    assert stays(first) and stays(third) and not stays(refused)
    store.prune(1, keep_versions=0)
    assert not stays(first) and stays(third)
    assert frames_of(copy, third).shape == (3, 64, 64, 3)
    assert len(read_versions(folder_of(copy))) == 3, "records stay: they are what is known of a version that is gone"


@pytest.mark.slow
def test_a_script_killed_before_it_publishes_goes_on_with_its_version(home):
    arguments = ["--preset", "smoke", *(part for option in OPTIONS for part in ("--set", option))]
    process = script("regenerate", *arguments, home=home, own_server=True)
    deadline = time.monotonic() + 300
    while len(digests(home, ("sample",))) < 2 and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    sampled = digests(home, ("sample",))
    assert len(sampled) == 2 and json.loads((folder_of(home) / "claimed.json").read_text())["number"] == 2
    finished = run_script("regenerate", *arguments, home=home, own_server=True)
    assert finished.status == 0, finished.errors
    assert "version 2 of smoke is published" in finished.output
    latest = read_latest(folder_of(home))
    assert latest is not None and latest.number == 2 and not (folder_of(home) / "claimed.json").exists()
    assert (
        digests(home, ("sample",)) == sampled and sampled[f"sample/{latest.synthetic.key}"] == latest.synthetic.digest
    )
