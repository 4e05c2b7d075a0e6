"""Foreign poses: what is sampled shows the motions of AMASS or AIST++, on tiny trees in their published layouts."""

import pickle

import numpy as np
import pytest
import scipy.sparse
from flow_scripts import run_script_here

from ctlev_core.body.layer import BUNDLED_BODY
from ctlev_core.geometry.joint_sets import SMPL_PARENTS
from data_contracts.manifest import ManifestRef, read_manifest

STUDIO = "{num_train_recordings: 4, num_test_recordings: 2, num_condition_recordings: 0}"


def amass(root):
    """One SMPL-H motion of two seconds: upright, z up."""
    (root / "CMU" / "01").mkdir(parents=True)
    poses = np.random.default_rng(0).normal(0, 0.2, (240, 156))
    poses[:, :3] = [np.pi / 2, 0, 0]
    arrays = {"trans": np.tile([0.0, 0.0, 1.0], (240, 1)), "poses": poses, "betas": np.zeros(16)}
    np.savez(
        root / "CMU" / "01" / "01_01_poses.npz",
        gender=np.array("female"),
        mocap_framerate=np.array(120.0),
        dmpls=np.zeros((240, 8)),
        **arrays,
    )


def aist(root):
    """One dance of two seconds: y up, centimetres."""
    (root / "motions").mkdir(parents=True)
    poses = np.random.default_rng(0).normal(0, 0.2, (120, 72)).astype(np.float32)
    poses[:, :3] = 0
    motion = {
        "smpl_poses": poses,
        "smpl_trans": np.tile(np.array([0.0, 100.0, 0.0], np.float32), (120, 1)),
        "smpl_scaling": np.array([95.0], np.float32),
        "smpl_loss": 1.0,
    }
    (root / "motions" / "gBR_sBM_cAll_d04_mBR0_ch01.pkl").write_bytes(pickle.dumps(motion))
    (root / "ignore_list.txt").write_text("")


def smpl(path):
    """The bundled body as SMPL's own file: a pickle, the joint regressor sparse, correctives and the tree's root."""
    with np.load(BUNDLED_BODY) as arrays:
        tree = dict(arrays)
    tree["J_regressor"] = scipy.sparse.csc_matrix(tree["J_regressor"])
    tree["posedirs"] = np.zeros((len(tree["v_template"]), 3, 207), np.float32)
    tree["kintree_table"] = np.array([[4294967295, *SMPL_PARENTS[1:]], range(24)], np.uint32)
    path.write_bytes(pickle.dumps(tree, protocol=2))
    return path


@pytest.mark.parametrize(
    ("preset", "write", "condition"),
    [
        ("amass", amass, "skeleton"),
        pytest.param("amass", amass, "normals", marks=pytest.mark.slow),
        pytest.param("aist", aist, "skeleton", marks=pytest.mark.slow),
        ("aist", aist, "normals of an SMPL file"),
    ],
)
def test_prepare_dataset(preset, write, condition, tmp_path):
    root, home = tmp_path / "poses", tmp_path / "home"
    write(root)
    condition, _, smpl_file = condition.partition(" of an ")
    settings = (
        f"poses.options.root={root}",
        f"dataset.options={STUDIO}",
        "num_synthetic=6",
        f"condition.name={condition}",
    )
    if smpl_file:
        body = smpl(tmp_path / "basicModel_neutral_lbs_10_207_0_v1.0.0.pkl")
        settings = (*settings, f"condition.options={{body: {body}}}")
    options = [word for setting in settings for word in ("--set", setting)]
    finished = run_script_here("prepare_dataset", "--preset", preset, *options, home=home)
    assert finished.status == 0, finished.errors
    (folder,) = (home / "artefacts" / "condition_samples").iterdir()
    conditions = read_manifest(ManifestRef(key=folder.name, path=folder))
    labels = conditions.labels
    assert labels.joint_set == "dhp19" and labels.joints2d is not None and labels.visible is not None
    assert labels.smpl_pose is not None and labels.visible.mean() > 0.9
    head, feet = labels.joints2d[:, 0, 1], labels.joints2d[:, -2:, 1].mean(axis=1)
    assert (head < feet).all(), "upright people, whatever axis points up in the file"
    images = conditions.array("images")
    assert len(images) == 6
    assert (home / "reports" / f"{preset}_conditions.html").stat().st_size > 10_000
    for image, joints, visible in zip(images, labels.joints2d, labels.visible, strict=True):
        drawn = (image != image[0, 0]).any(axis=-1)
        # Labelled joints lie inside the body that is drawn, and the body is a person's part of the picture.
        columns, rows = joints[visible].astype(int).T
        assert drawn[rows, columns].mean() > 0.9 and 0.02 < drawn.mean() < 0.4
