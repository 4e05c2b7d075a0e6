"""The presets of DHP19, CDEHP and Event-HPE: small trees in the published layouts become frames with conditions."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import test_cdehp
import test_dhp19_frames
import test_event_hpe
import yaml
from dhp19_writers import SPECIAL, START, address, write_aedat, write_vicon

from ctlev_core import plugins
from ctlev_core.plugins import PluginError
from data_contracts.config import DatasetChoice
from data_contracts.experiment import Experiment
from data_contracts.manifest import read_manifest
from tasks.condition import condition_frames, condition_samples
from tasks.encode import encode
from tasks.ingest import ingest
from tasks.store import Store

PRESETS = Path(__file__).resolve().parents[3] / "flows" / "presets"


def dhp19_raw(root: Path) -> None:
    """110,000 events a movement, dense enough to pass the filters: three windows of 30,000 and a rest."""
    test_dhp19_frames.write_matrices(root)
    random = np.random.default_rng(0)
    for subject in (1, 11, 13):
        pixels = random.integers([0, 150, 160], [4, 210, 220], (110_000, 3)).tolist()
        records = [(address(*pixel), START + 1 + 7 * i) for i, pixel in enumerate(pixels)]
        records = [(SPECIAL, START), (SPECIAL, START), *records, (SPECIAL, START + 900_000)]
        write_aedat(root / f"DVS_movies/S{subject}/session1/mov1.aedat", records)
        write_vicon(root / f"Vicon_data/S{subject}_1_1.mat")


def dhp19_frames(root: Path) -> None:
    test_dhp19_frames.write_matrices(root)
    for subject in (1, 11, 13):
        test_dhp19_frames.write_frames(root, f"S{subject}_session1_mov1", count=3)


def cdehp(root: Path) -> None:
    for shot in ("train/A0001P0001S00", "valid/A0001P0002S00"):
        test_cdehp.write_shot(root / "outdoor" / shot)
        for path in (root / "outdoor" / shot / "event_image").iterdir():
            picture = np.zeros((800, 1280), np.uint8)
            picture[200:600, 300:700] = 255
            assert cv2.imwrite(str(path), picture)


def event_hpe(root: Path) -> None:
    for subject in (1, 3, 4):
        test_event_hpe.write_preprocessed(root, f"subject{subject:02d}_group1_time1")


def load_experiment(name: str, root: Path) -> Experiment:
    """The preset with its root, every plug-in's options checked."""
    values = yaml.safe_load((PRESETS / f"{name}.yaml").read_text())
    values["dataset"]["options"]["root"] = str(root)
    experiment = Experiment(**values)
    for choice in experiment.choices:
        plugins.load_options(choice)
    return experiment


def run_stage(stage, **arguments):
    """What a Prefect task does, without Prefect."""
    return stage.run(stage.key(arguments, Store()), arguments)[0]


@pytest.mark.parametrize(
    ("write", "preset", "counts", "num_joints", "sampled_from"),
    [
        (dhp19_raw, "dhp19", {"train": 6, "test": 6}, 13, {"S11"}),
        (dhp19_frames, "dhp19", {"train": 6, "test": 6}, 13, {"S11"}),
        (cdehp, "cdehp", {"train": 2, "test": 2}, 13, {"outdoor_P0001"}),
        (event_hpe, "event_hpe", {"train": 3, "test": 3}, 24, {"subject03"}),
    ],
)
def test_a_preset_prepares_its_dataset(write, preset, counts, num_joints, sampled_from, tmp_path, home):
    write(tmp_path)
    experiment = load_experiment(preset, tmp_path)
    recordings = run_stage(ingest, dataset=experiment.dataset)
    frames = run_stage(encode, recordings=recordings, encoding=experiment.encoding, windows=experiment.windows)
    both = {"recordings": recordings, "frames": frames, "condition": experiment.condition, "seed": 0}
    both["encoding"] = experiment.encoding
    of_frames = read_manifest(run_stage(condition_frames, **both))
    asked = {"poses": recordings, "windows": experiment.windows, "count": 4, "order": "random", "views": "labelled"}
    of_samples = read_manifest(run_stage(condition_samples, **both, **asked))
    table = read_manifest(frames)
    assert {split: len(table.rows_where(split=split)) for split in counts} == counts
    pictures = table.array("frames")
    assert pictures.shape == (sum(counts.values()), 64, 64, 3) and all(picture.any() for picture in pictures)
    assert table.labels.joints2d is not None and table.labels.joints2d.shape[1:] == (num_joints, 2)
    assert np.isfinite(table.labels.joints2d).all()
    assert of_frames.array("images").shape == (counts["train"], 64, 64, 3) and of_frames.array("images")[:].any()
    assert set(of_samples.column("subject")) == sampled_from and len(of_samples) == 4


@pytest.mark.parametrize("preset", ["dhp19", "cdehp", "event_hpe"])
def test_a_preset_without_a_root_is_told_so(preset):
    values = yaml.safe_load((PRESETS / f"{preset}.yaml").read_text())
    with pytest.raises(PluginError, match="option 'root'"):
        plugins.load_options(DatasetChoice(**values["dataset"]))
