"""A generator that learns from one dataset and is asked for the classes of another, as in the paper: zero-shot."""

from __future__ import annotations

import json

import pytest
from flow_scripts import artefacts, digests, plan_script, run_script_here
from test_object_datasets import CLASSES, n_caltech101, n_imagenet, only

from ctlev_core.generators import stable_diffusion
from data_contracts.config import DatasetChoice
from flows.command_line import load_experiment

TINY = (
    "generator.options.num_steps=2", "generator.options.batch_size=2", "sampling.num_inference_steps=2",
    "downstream={name: classifier, options: {num_steps: 2, batch_size: 2, binary: balanced}}",
    "num_synthetic=6", "max_attempts=1",
    "feature_extractor={name: classifier, options: {num_steps: 2, batch_size: 2}}",
)  # fmt: skip
SEEN = {names.partition(",")[0] for names in CLASSES.values()}
UNSEEN = {"bonsai", "crocodile head"}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A home in which the experiment ran with a target, and what its plan was before it without one."""
    folder = tmp_path_factory.mktemp("target")
    for write in (n_imagenet, n_caltech101):
        (folder / write.__name__).mkdir()
        write(folder / write.__name__)
    target = f"target={{name: n_caltech101, options: {{root: {folder / 'n_caltech101'}}}}}"
    asked = [f"dataset.options.root={folder / 'n_imagenet'}", "training_sets=[recorded, synthetic]", *TINY]
    options = [argument for change in asked for argument in ("--set", change)]
    alone = plan_script("full_experiment", "--preset", "n_imagenet", *options, "--dry-run", home=folder / "home")
    assert alone.status == 0, alone.errors
    options += ["--set", target, "--set", "metrics=[{name: zero_shot}]"]
    finished = run_script_here("full_experiment", "--preset", "n_imagenet", *options, home=folder / "home")
    assert finished.status == 0, finished.errors
    return folder / "home", alone.plan


def test_the_generator_is_the_one_of_the_experiment_without_a_target(made):
    home, alone = made
    _, key = alone["finetune: stable_diffusion"]
    assert list(digests(home, ("finetune",))) == [f"finetune/{key}"]
    assert set(only(home, "condition_frames").column("class_name")) == SEEN


def test_only_the_targets_classes_are_sampled_learnt_and_tested(made):
    home, _ = made
    assert set(only(home, "sample").column("class_name")) == UNSEEN
    (of_target,) = (m for m in artefacts(home, "encode") if set(m.column("class_name")) == UNSEEN)
    scored = [row for m in artefacts(home, "score_model") for row in m.table.to_pylist()]
    tested = {row["data_digest"] for row in scored if row["subject"] in ("recorded", "synthetic")}
    assert tested == {of_target.ref.digest}
    assert {row["metric"] for row in scored} >= {"binary_accuracy_bonsai", "binary_accuracy_crocodile head"}
    # The judge of labels knows the target's classes; the features are those of what the generator has learnt.
    learnt = {json.dumps(sorted(json.loads(path.read_text())["classes"])) for path in home.glob(
        "artefacts/train_downstream/*/model/[cb]*.json")}  # fmt: skip
    assert learnt == {json.dumps(sorted(SEEN)), json.dumps(sorted(UNSEEN))}
    # As in the paper's Table 5, each of the target's classes has a network of its own.
    folders = [path.parent for path in home.glob("artefacts/train_downstream/*/model/binary.json")]
    assert folders and all(len(list(folder.glob("*/model.safetensors"))) == len(UNSEEN) for folder in folders)


def test_the_nearest_seen_classes_are_those_of_the_generators_own_text_encoder(made):
    home, _ = made
    table = only(home, "nearest_seen").table.to_pylist()
    assert [(row["unseen"], row["rank"]) for row in table] == [(name, r) for name in sorted(UNSEEN) for r in (1, 2)]
    (checkpoint,) = (home / "artefacts" / "finetune").glob("*/checkpoint")
    vectors = dict(zip(names := sorted(SEEN | UNSEEN), stable_diffusion.embed_names(checkpoint, names), strict=True))
    for row in table:
        a, b = vectors[row["unseen"]].astype(float), vectors[row["seen"]].astype(float)
        assert row["similarity"] == pytest.approx(a @ b / (a @ a) ** 0.5 / (b @ b) ** 0.5, abs=1e-6)
    page = (home / "reports" / "n_imagenet.html").read_text()
    assert "Nearest seen classes" in page and "the generator&#39;s, train" in page


def test_the_tested_dataset_is_the_target():
    experiment = load_experiment("zero_shot", [])
    assert experiment.target == experiment.tested_dataset and experiment.target in experiment.choices
    assert load_experiment("objects", []).tested_dataset == DatasetChoice(
        name="studio_objects", options={"num_train_per_class": 30, "num_test_per_class": 15}
    )
