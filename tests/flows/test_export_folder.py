"""From a preset to a plain folder of labelled images, as the quick start does it."""

import re

import cv2
import numpy as np
import pandas as pd
from flow_scripts import artefacts, plan_script, run_script_here

from ctlev_core.export.event_dataset import EventDataset


def test_synthesize_ends_in_a_plain_folder(smoke_home, tmp_path):
    folder = tmp_path / "mine"
    finished = run_script_here("synthesize", "--preset", "smoke", "--set", f"export_folder={folder}", home=smoke_home)
    assert finished.status == 0, finished.errors
    assert re.search(r"(\d+) stages, \1 of them cached", finished.output)  # the frames were there
    assert f"exported: {folder}" in finished.output
    (synthetic,) = artefacts(smoke_home, "sample", "generators/controlnet")
    kept = [row for row, refused in enumerate(synthetic.column("rejected")) if not refused]
    dataset, table = EventDataset(folder), pd.read_parquet(folder / "labels.parquet")
    assert len(dataset) == len(table) == len(kept) > 0
    assert "far too small to learn from" in (folder / "README.md").read_text()
    for index, row in enumerate(kept):
        frame = np.asarray(synthetic.array("frames")[row])
        image = np.asarray(dataset[index]["image"]).transpose(1, 2, 0)
        np.testing.assert_allclose(255 * image, frame, rtol=0, atol=1e-3)
        joints = np.asarray(dataset[index]["joints2d_px"])
        np.testing.assert_array_equal(joints, synthetic.labels.joints2d[row])
    pictures = sorted(folder.rglob("*.png"))
    assert all(cv2.imread(str(picture)) is not None for picture in pictures) and len(pictures) >= len(kept)


def test_a_folder_that_holds_something_else_is_refused_before_anything_is_sampled(tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "thesis.txt").write_text("years of work")
    finished = plan_script(
        "synthesize", "--preset", "smoke", "--set", f"export_folder={folder}", home=tmp_path / "home"
    )
    assert finished.status == 2
    (line,) = [line for line in finished.errors.splitlines() if line.startswith("error: ")]
    assert str(folder) in line
    assert [path.name for path in folder.iterdir()] == ["thesis.txt"]
    assert not (tmp_path / "home" / "artefacts").exists()
