"""The presets of the object datasets on tiny trees in their published layouts."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from flow_scripts import run_script_here

from data_contracts.manifest import ManifestRef, read_manifest

CLASSES = {"n01440764": "tench, Tinca tinca", "n02012849": "crane"}
SMALL = ("--set", "num_synthetic=8")


def n_caltech101(root):
    """Two classes of four ATIS files of 40 bits an event."""
    random = np.random.default_rng(0)
    for name in ("bonsai", "crocodile_head"):
        (root / name).mkdir(parents=True)
        for number in range(4):
            rows = [(*random.integers(0, 180, 2), random.integers(0, 2) << 7, t) for t in range(0, 3000, 10)]
            content = b"".join(struct.pack(">BBBH", *row) for row in rows)
            (root / name / f"image_{number:04d}.bin").write_bytes(content)


def n_imagenet(root):
    """Two classes of three training and one validation file, with lists and names."""
    lists = {"extracted_train": "train_list.txt", "extracted_val": "val_list.txt"}
    random = np.random.default_rng(0)
    for folder, count in (("extracted_train", 3), ("extracted_val", 1)):
        lines = []
        for wordnet_id in CLASSES:
            (root / folder / wordnet_id).mkdir(parents=True)
            for number in range(count):
                events = np.zeros(500, [("x", "<u2"), ("y", "<u2"), ("t", "<i8"), ("p", "?")])
                events["x"], events["y"] = random.integers(0, 640, 500), random.integers(0, 480, 500)
                events["t"] = np.sort(random.integers(0, 50_000, 500))
                np.savez_compressed(root / folder / wordnet_id / f"{number}.npz", event_data=events)
                lines.append(f"/home/jhkim/Datasets/N_Imagenet/{folder}/{wordnet_id}/{number}.npz\n")
        (root / lists[folder]).write_text("".join(lines))
    names = "".join(f"{wordnet_id} {names}\n" for wordnet_id, names in CLASSES.items())
    (root / "LOC_synset_mapping.txt").write_text(names)


def only(home, stage):
    (folder,) = (home / "artefacts" / stage).iterdir()
    return read_manifest(ManifestRef(key=folder.name, path=folder))


@pytest.mark.parametrize(
    ("write", "classes", "names"),
    [
        (n_caltech101, {"bonsai", "crocodile head"}, {"bonsai", "crocodile head"}),
        (n_imagenet, {"tench", "crane"}, {"tench", "Tinca tinca", "crane"}),
    ],
)
def test_prepare_dataset(write, classes, names, tmp_path):
    root, home = tmp_path / "data", tmp_path / "home"
    root.mkdir()
    write(root)
    arguments = ("--preset", write.__name__, "--set", f"dataset.options.root={root}", *SMALL)
    finished = run_script_here("prepare_dataset", *arguments, home=home)
    assert finished.status == 0, finished.errors
    frames = only(home, "encode")
    assert frames.array("frames").shape == (8, 64, 64, 3)
    assert set(frames.column("class_name")) == classes
    assert {split: len(frames.rows_where(split=split)) for split in ("train", "test")} == {"train": 6, "test": 2}
    prompts = only(home, "condition_frames").column("prompt") + only(home, "condition_samples").column("prompt")
    assert set(prompts) == {f"A photo of {name}" for name in names}
