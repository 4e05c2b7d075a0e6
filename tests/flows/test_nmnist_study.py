"""The study on recordings, from pictures to its page, on files that this test writes."""

import struct
from pathlib import Path

import numpy as np
import pytest
from flow_scripts import artefacts, plan_script, run_script_here

DIGITS = ("zero", "one", "seven")
SMALL = """
name: small
data_notice: far too small to learn from
paths: {nmnist: null, images: null, test: null}
pooled: {2 recordings a class: [draw_0, draw_1]}
experiments:
  draw_0:
    extends: nmnist_draw
    name: draw_0
    set:
      - "dataset.options.root={nmnist}"
      - "dataset.options.test_root={test?}"
      - "base_model.pictures.root={images}"
      - "generator.options.rehearsal.root={images}"
      - "baselines.random_weights.generator.options.rehearsal.root={images}"
      - "baselines.simulator.condition.options.root={images}"
      - oracle=null
      - dataset.options.recordings_per_class=2
      - num_generators=1
      - base_model.num_processes=1
      - base_model.widths=[32, 32]
      - base_model.chunk_scenes=16
      - base_model.workers=0
      - base_model.training.num_steps=2
      - base_model.training.batch_size=4
      - generator.options.num_steps=2
      - generator.options.batch_size=4
      - baselines.random_weights.generator.options.num_steps=2
      - baselines.random_weights.generator.options.batch_size=4
      - sampling.num_inference_steps=2
      - baselines.random_weights.sampling.num_inference_steps=2
      - num_synthetic=6
      - max_attempts=1
      - downstream.options.num_steps=3
      - feature_extractor.options.num_steps=3
      - "downstream_seeds=[0, 1]"
"""


def write_recording(path: Path, seed: int) -> None:
    """A square that sends events, as N-MNIST's files hold them."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, 300_000, 400)).tolist()
    x, y = rng.integers(8, 26, (2, 400)).tolist()
    p = rng.integers(0, 2, 400).tolist()
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = zip(x, y, t, p, strict=True)
    path.write_bytes(b"".join(struct.pack(">BBBH", a, b, d << 7 | c >> 16, c & 0xFFFF) for a, b, c, d in rows))


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    for number, name in enumerate(DIGITS):
        for recording in range(1, 15):
            write_recording(folder / "nmnist" / name / f"{recording:05d}.bin", 100 * number + recording)
        write_recording(folder / "apart" / str({"zero": 0, "one": 1, "seven": 7}[name]) / "00001.bin", number)
    images = np.random.default_rng(0).integers(0, 256, (60, 28, 28), dtype=np.uint8)
    np.savez(folder / "digits.npz", images=images, labels=np.array([0, 1, 7] * 20))
    first = SMALL[SMALL.index("  draw_0:\n") :]
    second = first.replace("draw_0", "draw_1") + "      - dataset.options.draw=1\n"
    (folder / "small.yaml").write_text(SMALL + second)
    return folder


def asked(data, *further):
    paths = {"nmnist": data / "nmnist", "images": data / "digits.npz"}
    given = [argument for name, path in paths.items() for argument in ("--set", f"paths.{name}={path}")]
    return ["--preset", str(data / "small.yaml"), *given, *further]


@pytest.mark.release
def test_the_study_runs_and_tells_every_row(data, tmp_path):
    finished = run_script_here("full_experiment", *asked(data), home=tmp_path)
    assert finished.status == 0, finished.errors
    (base,) = artefacts(tmp_path, "pretrain")
    assert (base.ref.path / "base_model" / "unet").is_dir(), "one base model for all draws and generators"
    page = (tmp_path / "reports" / "small.html").read_text()
    for row in ("2 recordings a class", "augmentation", "random", "simulat"):
        assert row in page
    frames = artefacts(tmp_path, "encode")
    assert all(manifest.array("frames").shape[1:] == (32, 32, 3) for manifest in frames)
    assert len({tuple(manifest.column("recording_id")) for manifest in frames}) == 2, "two draws"
    calibrated = [path for path in (tmp_path / "artefacts" / "simulate").glob("*/calibration.json")]
    assert len(calibrated) == 2, "fitted to each draw's own recordings"
    again = plan_script("full_experiment", *asked(data, "--dry-run"), home=tmp_path).plan
    assert again and {state for state, _ in again.values()} == {"cached"}


def test_other_recordings_may_be_tested(data, tmp_path):
    finished = plan_script(
        "full_experiment", *asked(data, "--set", f"paths.test={data / 'apart'}", "--dry-run"), home=tmp_path
    )
    assert finished.status == 0, finished.errors
    plain = plan_script("full_experiment", *asked(data, "--dry-run"), home=tmp_path)
    trained = [label for label in plain.plan if label.startswith("pretrain")]
    assert trained and all(plain.plan[label] == finished.plan[label] for label in trained)
    assert plain.plan.keys() == finished.plan.keys() and plain.plan != finished.plan


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            "experiments.draw_0.dataset.options.recordings_per_class=9",
            "is 9, and class 'zero' has",
        ),
        ("experiments.draw_0.dataset.options.classes=[two]", "no recordings of class 'two'"),
        ("paths.images=nowhere.npz", "nowhere.npz: no such file or folder"),
        ("experiments.draw_0.base_model.pictures.class_names=[a]", "label 7 has no name; class_names has 1"),
    ],
)
def test_what_is_missing_is_said_before_anything_runs(data, tmp_path, change, message):
    finished = plan_script("full_experiment", *asked(data, "--set", change), home=tmp_path)
    assert finished.status == 2 and message in finished.errors
    assert not (tmp_path / "artefacts").exists()
