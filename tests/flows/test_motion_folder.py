"""Motion files of anybody: every real one beside this checkout becomes skeletons and normals in
`prepare_dataset`."""

from __future__ import annotations

from pathlib import Path

import pytest
from flow_scripts import run_script_here

from data_contracts.manifest import ManifestRef, read_manifest

RECORDED = Path(__file__).resolve().parents[2].parent / "shared" / "real" / "motion"
STUDIO = "{num_train_recordings: 4, num_test_recordings: 2, num_condition_recordings: 0}"
CLASSES = {
    "cartwheel", "dance a", "jump", "kick", "punch", "run", "spinkick", "walk", "cmu_12_01_walk", "pybvh_test3",
}  # fmt: skip


@pytest.mark.parametrize("condition", ["skeleton", "normals"])
def test_prepare_dataset(condition, tmp_path):
    if not RECORDED.is_dir():
        pytest.skip("the recorded motions are not beside this checkout")
    settings = (
        "poses.name=motion_files",
        f"poses.options={{root: {RECORDED}, camera: centred}}",
        f"dataset.options={STUDIO}",
        f"condition.name={condition}",
        f"num_synthetic={4 * len(CLASSES)}",
    )
    options = [word for setting in settings for word in ("--set", setting)]
    finished = run_script_here("prepare_dataset", "--preset", "amass", *options, home=tmp_path)
    assert finished.status == 0, finished.errors
    (folder,) = (tmp_path / "artefacts" / "condition_samples").iterdir()
    conditions = read_manifest(ManifestRef(key=folder.name, path=folder))
    labels = conditions.labels
    assert set(labels.class_names) == CLASSES and labels.joints2d is not None and labels.visible is not None
    joints = labels.joints2d
    assert labels.visible.mean() > 0.98, "the camera looks at the pelvis from far enough"
    images = conditions.array("images")
    assert len(images) == 4 * len(CLASSES)
    for row, name in enumerate(labels.class_names):
        drawn = (images[row] != images[row][0, 0]).any(axis=-1)
        columns, rows = joints[row][labels.visible[row]].astype(int).T
        # Skeletons have gaps at the joints of sparse sets; a body covers what is labelled.
        assert drawn[rows, columns].mean() > (0.9 if condition == "normals" else 0.7), name
        assert drawn.mean() < 0.4
        if name in ("walk", "run", "cmu_12_01_walk", "pybvh_test3"):
            head, feet = joints[row, 0, 1], joints[row, -2:, 1]
            assert (head + 20 < feet).all(), f"{name}: upright people, whatever axis points up in the file"
