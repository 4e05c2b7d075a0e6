"""The whole chain, run as a user would."""

import contextlib
import json
import os
import re
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from flow_scripts import REPOSITORY, artefacts, digests, plan_script, run_script, run_script_here, script, told_stages

from ctlev_core.events.files import read_events_file
from ctlev_core.labels.body_views import smpl_joints
from data_contracts.labels import Labels
from data_contracts.manifest import MANIFEST_FILE, ManifestRef, conditions_of, read_manifest

# Everything but the report is a pure function of options and data: on one machine, digests must repeat exactly.
# The report's digest covers the time each stage took.
DETERMINISTIC = (
    "ingest", "encode", "condition_frames", "condition_samples", "finetune", "sample", "simulate", "train_downstream",
    "score_model", "score_distance", "event_realism", "realism_floors", "realism", "memorisation", "take_share",
    "take_label_consistent",
)  # fmt: skip


def test_smoke_ends_in_a_report(smoke_home):
    (report,) = (smoke_home / "reports").glob("*.html")
    text = report.read_text()
    assert "far too small to learn from" in text[:20_000]
    for expected in (
        "mpjpe2d",
        "fd_event_classifier_",
        "recorded+synthetic",
        "recorded+smpl_esim",
        "Does it copy?",
        "data:image/png;base64,",
    ):
        assert expected in text
    assert "http://" not in re.sub(r'xmlns(:\w+)?="[^"]*"', "", text) and "<script src" not in text
    output = (smoke_home / "first_run.txt").read_text()
    verdict, where, *_, last = output.splitlines()
    assert "adding synthetic frames to the recorded ones helped" in verdict and f"reports/{report.name}" in where
    total, told = told_stages((smoke_home / "first_run_errors.txt").read_text())
    assert sorted(int(one[1]) for one in told) == list(range(1, total + 1))
    assert re.fullmatch(rf"{total} stages, 0 of them cached, in .+", last)


def test_every_artefact_is_whole_and_says_where_it_came_from(smoke_home):
    seen = 0
    for record_file in (smoke_home / "artefacts").glob("*/*/run.json"):
        record = json.loads(record_file.read_text())
        manifest = read_manifest(
            ManifestRef(key=record_file.parent.name, path=record_file.parent, digest=record["digest"]), full=True
        )
        assert len(manifest) > 0
        seen += 1
    assert seen >= 15
    assert not list((smoke_home / "tmp").iterdir()) and not list((smoke_home / "work").iterdir())


def ask_prefect(home, query):
    """Rows of the database that the private servers of scripts leave behind."""
    with contextlib.closing(sqlite3.connect(home / "prefect" / "prefect.db")) as database:
        return database.execute(query).fetchall()


def test_prefect_has_recorded_every_stage_that_was_computed(smoke_home):
    messages = ask_prefect(smoke_home, "SELECT message FROM task_run_state WHERE name = 'Completed'")
    recorded = {message.rpartition(" ")[2] for (message,) in messages if ", key " in (message or "")}
    assert recorded >= {name.partition("/")[2][:12] for name in digests(smoke_home)}
    # Each further row is a write that requests wait for; see flows/local_server.py.
    assert ask_prefect(smoke_home, "SELECT COUNT(*) FROM events") == [(0,)]


GENERATORS = {
    "synthetic": ("sample", "generators/controlnet", "conditions/skeleton"),
    "event_gan": ("sample", "generators/event_gan", "conditions/intensity_pair"),
    "smpl_esim": ("simulate", "generators/smpl_esim", "conditions/body_motion"),
}


@pytest.mark.parametrize("name", GENERATORS)
def test_labels_travel_from_condition_to_synthetic_frame(smoke_home, name):
    stage, generator, condition = GENERATORS[name]
    (synthetic,) = artefacts(smoke_home, stage, generator)
    (conditions,) = artefacts(smoke_home, "condition_samples", condition)
    assert synthetic.column("condition_id") == conditions.column("sample_id")
    np.testing.assert_array_equal(synthetic.labels.joints2d, conditions.labels.joints2d)
    assert synthetic.array("frames").shape == (len(synthetic), 64, 64, 3)
    assert len(set(synthetic.column("seed"))) == len(synthetic)


def test_every_generator_is_asked_for_the_same_labels(smoke_home):
    asked = [artefacts(smoke_home, "condition_samples", condition)[0] for _, _, condition in GENERATORS.values()]
    for others in asked[1:]:
        assert others.column("source_id") == asked[0].column("source_id")
        np.testing.assert_array_equal(others.labels.smpl_pose, asked[0].labels.smpl_pose)
        np.testing.assert_array_equal(others.labels.joints2d, asked[0].labels.joints2d)


def test_simulated_events_lie_on_the_body_they_were_asked_for(smoke_home):
    """They lie within the box of its joints in all that it does while it is recorded, widened by flesh and clothes."""
    (simulated,) = artefacts(smoke_home, "simulate")
    (conditions,) = artefacts(smoke_home, "condition_samples", "conditions/body_motion")
    motions = conditions_of(conditions).motions
    for row, frame in enumerate(simulated.array("frames")):
        joints = smpl_joints(
            Labels(
                ("",) * motions.t_us.shape[1],
                motions.t_us[row],
                smpl_pose=motions.smpl_pose[row],
                smpl_betas=np.tile(motions.smpl_betas[row], (motions.t_us.shape[1], 1)),
                smpl_transl=motions.smpl_transl[row],
            )
        )
        focal, centre = motions.intrinsics[row, :2], motions.intrinsics[row, 2:]
        points = (joints[..., :2] / joints[..., 2:] * focal + centre).reshape(-1, 2)
        low, high = points.min(axis=0) - 6, points.max(axis=0) + 6  # px of 64; a head is 5 px above its joint
        y, x = np.nonzero(frame.max(axis=-1))
        assert len(x) > 0
        inside = (x + 0.5 >= low[0]) & (x + 0.5 <= high[0]) & (y + 0.5 >= low[1]) & (y + 0.5 <= high[1])
        assert inside.all()


def test_training_and_test_subjects_are_disjoint(smoke_home):
    subjects = {split: set() for split in ("train", "test")}
    for frames in artefacts(smoke_home, "encode"):  # the experiment's own, and more recorded frames to train on
        for split, subject in zip(frames.column("split"), frames.column("subject"), strict=True):
            subjects[split].add(subject)
    assert subjects["train"] and subjects["test"] and not subjects["train"] & subjects["test"]


BARE_FLOW = """
from prefect import flow, task

@task
def one():
    return 1

@flow
def bare():
    return one()

assert bare() == 1
"""


def seconds(command, **options):
    started = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True, **options)
    return time.perf_counter() - started


def test_a_second_run_recomputes_nothing(smoke_home):
    before = digests(smoke_home)
    finished = run_script("full_experiment", "--preset", "smoke", home=smoke_home, own_server=True)
    assert finished.status == 0, finished.errors
    assert digests(smoke_home) == before
    # Prefect's record of it.
    query = """
        SELECT artifact.data FROM artifact JOIN flow_run ON flow_run.id = artifact.flow_run_id
        JOIN flow ON flow.id = flow_run.flow_id
        WHERE artifact.key = 'plan' AND flow.name = 'full-experiment' AND flow_run.state_name = 'Completed'
        ORDER BY artifact.created DESC LIMIT 1"""
    ((plan,),) = ask_prefect(smoke_home, query)
    while isinstance(plan, str):
        plan = json.loads(plan)
    assert {row["plan"] for row in plan} == {"cached"}
    assert {row["key"] for row in plan} == {name.partition("/")[2] for name in before}


@pytest.mark.slow
def test_a_second_run_is_as_quick_as_a_bare_flow(smoke_home):
    """Beside a one-task flow on Prefect's own embedded server, telemetry off and start-up limit raised."""
    again = [sys.executable, str(REPOSITORY / "flows/full_experiment.py"), "--preset", "smoke"]
    bare = [sys.executable, "-c", BARE_FLOW]
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PREFECT_")}
    quiet = {
        "DO_NOT_TRACK": "1",
        "PREFECT_HOME": str(smoke_home / "prefect"),
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "300",
    }
    differences = []
    for _ in range(3):  # interleaved, because the machine's speed drifts
        cached = seconds([*again, "--home", str(smoke_home)], cwd=smoke_home, env=environment)
        differences.append(cached - seconds(bare, cwd=smoke_home, env=environment | quiet))
        if sum(difference < 5 for difference in differences) == 2:
            break  # which is the median, whatever the third is
    assert sorted(differences)[1] < 5, differences


@pytest.mark.parametrize(
    ("override", "changed"),
    [
        (
            "downstream.options.num_steps=21",
            {"train_downstream: pose2d", "judge of labels", "label_consistent", "score_model", "report"},
        ),
        (
            "num_synthetic=9",
            {
                "condition_samples",
                "sample:",
                "simulate",
                "synthetic",
                "label_consistent",
                "on event_gan",
                "on smpl_esim",
                "+event_gan",
                "+smpl_esim",
                "label agreement of",
                "score_distance: event_gan",
                "score_distance: smpl_esim",
                "realism: event_gan",
                "realism: smpl_esim",
                "memorisation",
                "report",
                "contact_sheet",
            },
        ),
        (
            "baselines.event_gan.generator.options.num_steps=7",
            {
                "finetune: event_gan",
                "sample: event_gan",
                "on event_gan",
                "+event_gan",
                "label agreement of event_gan",
                "score_distance: event_gan",
                "realism: event_gan",
                "memorisation: event_gan",
                "report",
            },
        ),
        (
            "encoding.options.normalisation=max",
            {
                "encode",
                "condition",
                "finetune",
                "sample",
                "simulate",
                "train",
                "take_",
                "score",
                "realism_floors",
                "realism: event_gan",
                "realism: smpl_esim",
                "realism: synthetic",
                "memorisation",
                "report",
            },
        ),
        ("name=renamed", {"report", "contact_sheet"}),
    ],
)
def test_changing_an_option_reruns_exactly_what_depends_on_it(smoke_home, override, changed):
    base = plan_script("full_experiment", "--preset", "smoke", "--dry-run", home=smoke_home).plan
    assert base and {state for state, _ in base.values()} == {"cached"}
    plan = plan_script("full_experiment", "--preset", "smoke", "--set", override, "--dry-run", home=smoke_home).plan
    assert plan.keys() == base.keys() or override.startswith("name")
    for label, (state, key) in plan.items():
        expected = any(part in label for part in changed)
        assert (state == "to run") == expected, (label, state)
        if label in base:
            assert (key != base[label][1]) == expected


@pytest.mark.slow
def test_each_flow_is_a_script_of_its_own_and_shares_the_store(smoke_home):
    before = digests(smoke_home)
    for name in ("prepare_dataset", "train_generator", "synthesize", "baselines", "evaluate"):
        finished = run_script(name, "--preset", "smoke", home=smoke_home)
        assert finished.status == 0, finished.errors
        assert re.search(r"(\d+) stages, \1 of them cached", finished.output)
    assert digests(smoke_home) == before


@pytest.mark.slow
def test_killed_runs_end_in_the_same_digests(smoke_home, tmp_path):
    """`kill -9` at random moments, then a rerun: nothing half-written, every digest as in the undisturbed run."""
    random = np.random.default_rng(20261121)
    for _ in range(4):
        process = script("full_experiment", "--preset", "smoke", home=tmp_path, own_server=True, start_new_session=True)
        try:
            process.wait(timeout=float(random.uniform(8, 35)))
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGKILL)
        process.communicate()
        for manifest in (tmp_path / "artefacts").glob(f"*/*/{MANIFEST_FILE}"):
            read_manifest(ManifestRef(key=manifest.parent.name, path=manifest.parent), full=True)
    finished = run_script("full_experiment", "--preset", "smoke", home=tmp_path, own_server=True)
    assert finished.status == 0, finished.errors
    assert digests(tmp_path, DETERMINISTIC) == {
        name: digest
        for name, digest in digests(smoke_home, DETERMINISTIC).items()
        if name in digests(tmp_path, DETERMINISTIC)
    }
    assert len(digests(tmp_path, DETERMINISTIC)) >= 14
    assert not list((tmp_path / "tmp").iterdir())


def test_private_server_dies_with_a_killed_script(tmp_path):
    process = script("full_experiment", "--preset", "smoke", home=tmp_path, own_server=True)
    deadline = time.monotonic() + 60
    children = []
    while not children and time.monotonic() < deadline:
        time.sleep(0.2)
        children = [int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]
    assert children, "the private Prefect server did not start"
    process.kill()
    process.communicate()
    deadline = time.monotonic() + 20
    while any(os.path.exists(f"/proc/{pid}") for pid in children) and time.monotonic() < deadline:
        time.sleep(0.2)
    assert not any(os.path.exists(f"/proc/{pid}") for pid in children)


def test_synthetic_frames_become_event_files(smoke_home):
    """The frames of a finished run, read back and counted again."""
    finished = run_script_here("export_events", "--preset", "smoke", "--set", "export={format: evt3}", home=smoke_home)
    assert finished.status == 0, finished.errors
    folder = smoke_home / "events" / "smoke"
    listed = pq.read_table(folder / "event_streams.parquet").to_pylist()
    (synthetic,) = artefacts(smoke_home, "sample", "generators/controlnet")
    assert [row["sample_id"] for row in listed] == synthetic.column("sample_id")
    for row in listed:
        events = read_events_file(folder / row["file"])
        assert len(events) == row["num_events"] > 0 and events.sensor_size == (64, 64)


def test_scores_are_tables(smoke_home):
    tables = list((smoke_home / "reports").glob("*/scores.parquet"))
    assert len(tables) == 1
    scores = pq.read_table(tables[0]).to_pylist()
    trained = {"recorded"} | {f"{real}{name}" for real in ("", "recorded+") for name in GENERATORS}
    trained |= {"label_consistent", "recorded+label_consistent", "oracle", "recorded+oracle", "recorded+synthetic@0.5"}
    judged = {f"label agreement of {name}" for name in GENERATORS} | {"shuffled label agreement of synthetic"}
    assert {row["subject"] for row in scores if row["task"] == "pose2d"} == trained | judged
    assert {row["subject"] for row in scores if row["task"] == "distance"} == {"held-out recorded", *GENERATORS}
    assert all(np.isfinite(row["value"]) for row in scores)
