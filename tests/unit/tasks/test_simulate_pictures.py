"""The stage `simulate` without motions: pictures recorded as whole recordings, fitted to those of training."""

import json

import numpy as np
import pytest

from ctlev_core.events.files import write_events_parquet
from ctlev_core.generators import picture_simulator
from data_contracts.config import ConditionChoice, DatasetChoice, EncodingChoice, SamplingChoice, Windows
from data_contracts.errors import DataError
from data_contracts.experiment import Experiment
from data_contracts.labels import Conditions
from data_contracts.manifest import read_manifest
from flows.inputs import InputsMissing, check_inputs
from tasks.condition import condition_samples
from tasks.encode import encode
from tasks.ingest import ingest
from tasks.sample import simulate
from tasks.store import Store

COUNTED = EncodingChoice(name="event_histogram", options={"polarity": True})
MADE_WITH = {"threshold": 0.3, "threshold_off": 0.33, "negative": True, "leak_rate_hz": 1.0}
COUNT = 6


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """Recordings of upright and lying strokes, and pictures of others."""
    root = tmp_path_factory.mktemp("pictures")
    rng = np.random.default_rng(0)
    images = np.zeros((24, 28, 28), np.uint8)
    for number, image in enumerate(images):
        image[5 : rng.integers(18, 22), rng.integers(9, 12) : rng.integers(14, 17)] = 255
        if number % 2:
            image[:] = image.T.copy()
    labels = np.array(["upright", "lying"])[np.arange(24) % 2]
    np.savez(root / "pictures.npz", images=images[8:].repeat(2, axis=0), labels=labels[8:].repeat(2))
    asked = Conditions(("",) * 8, np.repeat(images[:8, ..., None], 3, axis=3))
    options = picture_simulator.SampleOptions.model_validate(MADE_WITH)
    made = picture_simulator.sample_events(asked, (34, 34), options, seeds=range(8))
    for number, (events, name) in enumerate(zip(made, labels, strict=False)):
        folder = root / "recordings" / str(name)
        folder.mkdir(parents=True, exist_ok=True)
        write_events_parquet(folder / f"{number}.parquet", events)
    return root


def run(stage, **arguments):
    return stage.run(stage.key(arguments, Store()), arguments)[0]


def make(home, patch, inputs, windows, sampling=None, condition="picture", seed=2):
    patch.setenv("CTLEV_HOME", str(home))
    options = {"root": str(inputs / "recordings"), "split": "recording", "test_fraction": 0.25}
    recordings = run(ingest, dataset=DatasetChoice(name="folder", options=options))
    given = {"recordings": recordings, "encoding": COUNTED, "windows": windows}
    given["frames"] = run(encode, **given)
    shown = {"root": str(inputs / "pictures.npz")} if condition == "picture" else {}
    choice = ConditionChoice(name=condition, options=shown)
    asked = run(
        condition_samples, poses=recordings, condition=choice, order="random", views="labelled", count=COUNT, seed=1,
        **given,
    )  # fmt: skip
    chosen = SamplingChoice(name="picture_simulator", options=sampling or {})
    made = run(simulate, conditions=asked, sampling=chosen, seed=seed, **given)
    return read_manifest(made, full=True), read_manifest(asked), read_manifest(given["frames"])


def test_whole_recordings_are_simulated_and_fitted_to_those_of_training(tmp_path, monkeypatch, inputs):
    whole = Windows(method="whole")
    made, asked, frames = make(tmp_path, monkeypatch, inputs, whole)
    assert len(made) == COUNT and made.column("class_name") == asked.column("class_name")
    found = json.loads((made.ref.path / "calibration.json").read_text())
    assert found["options"]["threshold"] == pytest.approx(0.3, rel=0.1) and found["options"]["negative"] is True
    assert found["measured"]["recordings"] == 6 and "calibration.json" in made.files
    # The frame of a row is that of all events of its picture, from its own seed.
    options = picture_simulator.SampleOptions.model_validate(found["options"])
    shown = Conditions(("",) * COUNT, np.asarray(asked.array("images")))
    lit = [np.asarray(frame).any(axis=-1) for frame in made.array("frames")]
    events = picture_simulator.sample_events(shown, (34, 34), options, seeds=made.column("seed"))
    for image, of_row in zip(lit, events, strict=True):
        active = np.zeros((34, 34), bool)
        active[of_row.y, of_row.x] = True
        assert (image & ~active).sum() == 0 and image.sum() > 0.5 * active.sum()
    real = np.asarray(frames.array("frames"))[frames.rows_where(split="train")]
    assert np.asarray(made.array("frames")).mean() == pytest.approx(real.mean(), rel=0.25)


@pytest.mark.slow
def test_recordings_and_their_calibration_are_the_same_again(tmp_path, monkeypatch, inputs):
    (first, *_), (again, *_) = (make(tmp_path / n, monkeypatch, inputs, Windows(method="whole")) for n in "ab")
    assert again.ref.digest == first.ref.digest


@pytest.mark.slow
def test_options_of_the_user_win_and_other_windows_are_around_the_middle(tmp_path, monkeypatch, inputs):
    made, *_ = make(tmp_path, monkeypatch, inputs, Windows(method="count", num_events=300), {"threshold": 0.4})
    found = json.loads((made.ref.path / "calibration.json").read_text())
    assert found["options"]["threshold"] == 0.4
    assert (np.asarray(made.array("frames")).reshape(COUNT, -1) > 0).any(axis=1).all()


def test_a_condition_without_pictures_is_refused(tmp_path, monkeypatch, inputs):
    with pytest.raises(DataError, match="needs pictures; use condition 'picture'"):
        make(tmp_path, monkeypatch, inputs, Windows(method="whole"), condition="text")


def test_a_class_without_pictures_is_said_before_anything_runs(inputs):
    def experiment(class_folders):
        return Experiment.model_validate(
            {
                "name": "test",
                "dataset": {"name": "folder", "options": {"root": str(inputs / class_folders)}},
                "encoding": {"name": "event_histogram"},
                "condition": {"name": "text"},
                "generator": {"name": "stable_diffusion"},
                "num_synthetic": 2,
                "downstream": {"name": "classifier"},
                "metrics": [{"name": "classification"}],
                "baselines": {
                    "simulator": {
                        "condition": {"name": "picture", "options": {"root": str(inputs / "pictures.npz")}},
                        "generator": {"name": "picture_simulator"},
                    }
                },
            }
        )

    check_inputs(experiment("recordings"))
    other = inputs / "others" / "slanted"
    other.mkdir(parents=True)
    (other / "0.parquet").write_bytes(next((inputs / "recordings").rglob("*.parquet")).read_bytes())
    with pytest.raises(InputsMissing, match="has no picture of class 'slanted'; there are: lying, upright"):
        check_inputs(experiment("others"))
