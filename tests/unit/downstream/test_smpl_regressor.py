"""The body regressor: what it learns, what it refuses, and that mirrored and shifted samples are the same people."""

from dataclasses import replace

import numpy as np
import pytest

from ctlev_core.body.layer import BUNDLED_BODY, joint_transforms, load_body
from ctlev_core.body.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from ctlev_core.conditions import normals
from ctlev_core.downstream import smpl_regressor
from ctlev_core.geometry.joint_sets import JOINT_SETS
from ctlev_core.labels.body_views import with_joints
from ctlev_core.supervised.augmentation import BodySamples, mirror_half, shift
from data_contracts.errors import DataError
from data_contracts.labels import Labels

SIZE = (32, 32)
TINY = smpl_regressor.Options(num_steps=60, batch_size=16, warmup_steps=5, log_every=10, shift_px=1, device="cpu")


def people(count=48, seed=0):
    """Bodies that differ in their arms and their place, before one camera."""
    random = np.random.default_rng(seed)
    pose = np.zeros((count, 72), np.float32)
    pose[:, :3] = [np.pi, 0, 0]
    pose[:, 3 * 16 + 2] = random.uniform(-1.2, 1.2, count)
    pose[:, 3 * 17 + 2] = random.uniform(-1.2, 1.2, count)
    labels = Labels(
        ("",) * count,
        np.arange(count),
        smpl_pose=pose,
        smpl_betas=np.zeros((count, 10), np.float32),
        smpl_transl=random.uniform([-0.2, -0.1, 3.0], [0.2, 0.3, 3.4], (count, 3)).astype(np.float32),
        intrinsics=np.tile(np.array([45, 45, 16, 16], np.float32), (count, 1)),
    )
    return with_joints(labels, SIZE, "smpl")


def pictures(labels):
    return normals.render(labels, SIZE, normals.Options(convention="rgb", workers=1), range(len(labels))).images


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("regressor")
    labels = people()
    history = smpl_regressor.train(pictures(labels), labels, TINY, seed=0, out=folder / "a", work=folder / "w")
    return folder / "a", history


def test_it_learns_to_see_the_body(trained):
    model, history = trained
    assert history.step[-1] == 60 and history.loss[-1] < 0.5 * history.loss[0]
    unseen = people(24, seed=1)
    found = smpl_regressor.predict(model, pictures(unseen))
    error = np.linalg.norm(found["joints3d"] - unseen.joints3d, axis=-1).mean()
    guess = np.linalg.norm(people().joints3d.mean(axis=0) - unseen.joints3d, axis=-1).mean()
    assert error < 0.8 * guess


def test_predictions_fit_together(trained):
    found = smpl_regressor.predict(trained[0], pictures(people(5, seed=2)))
    shapes = {name: array.shape for name, array in found.items()}
    assert shapes == {
        "smpl_pose": (5, 72),
        "smpl_betas": (5, 10),
        "smpl_transl": (5, 3),
        "joints3d": (5, 24, 3),
        "joints2d": (5, 24, 2),
    }
    rotations = matrix_from_axis_angle(found["smpl_pose"].reshape(5, 24, 3))
    for row in range(5):
        _, joints = joint_transforms(
            load_body(), rotations[row : row + 1], found["smpl_betas"][row], found["smpl_transl"][row : row + 1]
        )
        np.testing.assert_allclose(found["joints3d"][row], 1000 * joints[0], atol=0.05)
    in_image = 45 * found["joints3d"][..., :2] / found["joints3d"][..., 2:] + 16
    np.testing.assert_allclose(found["joints2d"], in_image, atol=1e-3)


def test_no_frames_give_no_bodies(trained):
    found = smpl_regressor.predict(trained[0], np.zeros((0, 32, 32, 3), np.uint8))
    assert {len(array) for array in found.values()} == {0} and found["joints3d"].shape == (0, 24, 3)


def test_a_run_goes_on_where_it_stopped(trained, tmp_path):
    labels = people()
    frames = pictures(labels)
    stopped = TINY.model_copy(update={"checkpoint_every_s": 0.0})

    class Killed(Exception):
        pass

    def killed_at(step):
        real = smpl_regressor._loss
        calls = iter(range(10**6))

        def loss(*arguments):
            if next(calls) == step:
                raise Killed
            return real(*arguments)

        return loss

    with pytest.MonkeyPatch.context() as patch, pytest.raises(Killed):
        patch.setattr(smpl_regressor, "_loss", killed_at(45))
        smpl_regressor.train(frames, labels, stopped, seed=0, out=tmp_path / "a", work=tmp_path / "w")
    smpl_regressor.train(frames, labels, stopped, seed=0, out=tmp_path / "a", work=tmp_path / "w")
    assert (tmp_path / "a" / "model.safetensors").read_bytes() == (trained[0] / "model.safetensors").read_bytes()


def batch_of(labels):
    rotations = matrix_from_axis_angle(labels.smpl_pose.reshape(-1, 24, 3)).astype(np.float32)
    return BodySamples(pictures(labels), rotations, labels.smpl_betas, labels.smpl_transl, labels.intrinsics)


def rerendered(batch, labels):
    """The frames that the normals' renderer makes of a batch's bodies."""
    pose = axis_angle_from_matrix(batch.rotations.astype(np.float64)).reshape(-1, 72).astype(np.float32)
    return pictures(replace(labels, smpl_pose=pose, smpl_transl=batch.transl, intrinsics=batch.intrinsics))


class Always:
    """A generator that mirrors everything and shifts by a fixed amount."""

    def random(self, count):
        return np.zeros(count)

    def integers(self, low, high, size):
        return np.tile([2, -1], (size[0], 1))


def test_a_mirrored_sample_is_the_mirrored_body():
    labels = people(6)
    mirrored = mirror_half(batch_of(labels), np.arange(6), Always())
    silhouettes = [frames.any(axis=-1) for frames in (mirrored.frames, rerendered(mirrored, labels))]
    # The body is symmetric, so only pixels whose centres the outline all but touches may differ.
    assert (silhouettes[0] != silhouettes[1]).mean() < 0.002
    assert JOINT_SETS["smpl"].mirror[16] == 17


def test_a_shifted_sample_is_the_shifted_body():
    labels = people(6)
    shifted = shift(batch_of(labels), 2, np.arange(6), Always())
    silhouettes = [frames.any(axis=-1) for frames in (shifted.frames, rerendered(shifted, labels))]
    # The view turns by 2 / 45 rad: a few pixels of the outline change.
    assert (silhouettes[0] != silhouettes[1]).mean() < 0.02


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"smpl_pose": None, "smpl_betas": None, "smpl_transl": None}, "no SMPL parameters"),
        ({"intrinsics": None}, "no camera intrinsics"),
    ],
)
def test_labels_without_bodies_are_refused(change, message, tmp_path):
    labels = people(4)
    with pytest.raises(DataError, match=message):
        smpl_regressor.train(
            pictures(labels), replace(labels, **change), TINY, seed=0, out=tmp_path / "a", work=tmp_path / "w"
        )


def test_another_number_of_frames_is_refused(tmp_path):
    labels = people(4)
    with pytest.raises(DataError, match="3 frames but 4 labels"):
        smpl_regressor.train(pictures(labels)[:3], labels, TINY, seed=0, out=tmp_path / "a", work=tmp_path / "w")


def test_joints_are_those_of_the_body_that_was_named(tmp_path):
    with np.load(BUNDLED_BODY) as arrays:
        tree = dict(arrays)
    tree["v_template"] = 1.5 * tree["v_template"]
    file = tmp_path / "large.npz"
    np.savez(file, **tree)
    large, labels = load_body(file), people(4)
    options = TINY.model_copy(update={"body": file, "num_steps": 2, "batch_size": 2})
    assert smpl_regressor.input_files(options) == [file]
    smpl_regressor.train(pictures(labels), labels, options, seed=0, out=tmp_path / "a", work=tmp_path / "w")
    file.unlink()  # a licensed file need not be where a model is used
    found = smpl_regressor.predict(tmp_path / "a", pictures(labels))
    rotations = matrix_from_axis_angle(found["smpl_pose"].reshape(-1, 24, 3))
    _, joints = joint_transforms(large, rotations, found["smpl_betas"], found["smpl_transl"])
    np.testing.assert_allclose(found["joints3d"], 1000 * joints, atol=0.05)
    with pytest.raises(DataError, match=r"large\.npz: no such file; expected an SMPL body"):
        smpl_regressor.input_files(options)
