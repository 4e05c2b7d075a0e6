"""Students in a whole run: a stage of their own, made once, beside the generator that they imitate; and from Python."""

import json

import numpy as np
import pytest
from flow_scripts import artefacts, plan_script, run_script_here

from ctlev_core.provenance.records import read_records, write_provenance
from ctlev_core.trained_generator import load_generator

SMALL = (
    "dataset.options={num_train_recordings: 4, num_test_recordings: 1, num_condition_recordings: 6}",
    "windows.max_windows=2",
    "generator.options={tune: both, num_steps: 2, batch_size: 2}",
    "sampling={num_inference_steps: 3, palette: grey}",
    "num_synthetic=6",
    "max_attempts=1",
    "pixel_decoder={num_steps: 4, batch_size: 2, width: 16, depth: 1, time_steps: [500], evaluations: 2}",
    "oracle=null",
    "baselines={}",
)
STUDENT = "num_steps: 2, batch_size: 2, teacher_evaluations: 2"
BASELINES = f"baselines={{teacher: {{}}, hasty: {{student: {{num_evaluations: 1, {STUDENT}}}}}}}"


def settings(*further):
    return [word for setting in (*SMALL, *further) for word in ("--set", setting)]


def run(home, *further, script="synthesize"):
    return run_script_here(script, "--preset", "pose", *settings(*further), home=home)


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    place = tmp_path_factory.mktemp("home")
    for script in ("synthesize", "baselines"):
        finished = run(place, f"student={{num_evaluations: 2, {STUDENT}}}", BASELINES, script=script)
        assert finished.status == 0, finished.errors
    return place


def arguments_of(manifest):
    return json.loads((manifest.ref.path / "run.json").read_text())["arguments"]


def test_students_share_the_fine_tuning_and_the_decoder(home):
    (tuned,), students = artefacts(home, "finetune"), artefacts(home, "distill")
    assert {arguments_of(one)["options"]["num_evaluations"] for one in students} == {1, 2}
    assert {arguments_of(one)["checkpoint"]["manifest"] for one in students} == {tuned.ref.key}
    sampled = {arguments_of(one)["checkpoint"]["manifest"]: arguments_of(one)["sampling"]["options"]
               for one in artefacts(home, "sample")}  # fmt: skip
    assert sampled.keys() == {tuned.ref.key, *(one.ref.key for one in students)}
    for one in students:
        options = sampled[one.ref.key]
        number = arguments_of(one)["options"]["num_evaluations"]
        assert (options["scheduler"], options["num_inference_steps"]) == ("tcd", number)
    assert sampled[tuned.ref.key]["scheduler"] == "unipc"
    (decoder,) = artefacts(home, "train_pixel_decoder")
    assert arguments_of(decoder)["checkpoint"]["manifest"] == tuned.ref.key
    first, second, third = (np.asarray(one.array("frames")) for one in artefacts(home, "decode_pixels"))
    assert (first != second).any() and (second != third).any() and (first != third).any()


def test_a_second_run_makes_nothing(home):
    asked = settings(f"student={{num_evaluations: 2, {STUDENT}}}", BASELINES)
    planned = plan_script("baselines", "--preset", "pose", "--dry-run", *asked, home=home)
    assert planned.plan and {state for state, _ in planned.plan.values()} == {"cached"}, planned


def test_from_python_the_same_frames_come(home):
    (asked,) = artefacts(home, "condition_samples")
    student = next(one for one in artefacts(home, "distill") if arguments_of(one)["options"]["num_evaluations"] == 2)
    made = next(one for one in artefacts(home, "sample")
                if arguments_of(one)["checkpoint"]["manifest"] == student.ref.key)  # fmt: skip
    drawn = next(one for one in artefacts(home, "decode_pixels")
                 if arguments_of(one)["synthetic"]["manifest"] == made.ref.key)  # fmt: skip
    folder = home / "reports" / "mine"
    folder.mkdir(parents=True)
    roles = [("checkpoint of synthetic", student.ref.path), ("frames of synthetic", drawn.ref.path)]
    write_provenance(folder / "provenance.json", read_records(roles))
    again = load_generator("mine", home=home).sample(asked.column("prompt"), images=asked.array("images"))
    np.testing.assert_array_equal(again, np.asarray(drawn.array("frames")))


def test_what_does_not_go_together_is_refused_before_anything_runs(tmp_path):
    for further, message in (
        ("student={num_evaluation: 4}", "student: unknown option 'num_evaluation'"),
        ("student={num_evaluations: 9}", "student: option 'num_evaluations'"),
        ("sampling.scheduler=tcd", "sampling.scheduler: a student gets 'tcd' by itself"),
        ("student={snr_gamma: 5}", "a student learns from trajectories"),
        ("baselines={other: {student: {}, sampling: {controlnet_every: 2}}}", "baselines.other.student: expected"),
        ("baselines={other: {student: {}, generator: {name: smpl_esim}}}", "baselines.other.student: expected a diff"),
    ):
        script = "baselines" if "baselines" in further else "synthesize"
        finished = plan_script(script, "--preset", "pose", *settings(further), home=tmp_path)
        assert finished.status == 2 and message in finished.errors, finished.errors
    options = ["--set", "student={}", "--set", "motion_layers={}"]
    finished = plan_script("synthesize", "--preset", "sequences", *options, home=tmp_path)
    assert finished.status == 2 and "a generator with motion layers cannot be distilled" in finished.errors
    assert not (tmp_path / "artefacts").exists()
