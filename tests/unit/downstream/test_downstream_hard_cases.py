"""What real training sets do: one row, rows without a visible joint, labels that are not numbers, half turns."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from ctlev_core.body.rotations import matrix_from_axis_angle
from ctlev_core.body.torch_rotations import matrix_from_rotation_6d, rotation_6d_from_matrix
from ctlev_core.downstream import classifier, pose2d, smpl_regressor
from ctlev_core.metrics import classification
from ctlev_core.networks.dhp19 import DHP19Network
from data_contracts.errors import DataError
from data_contracts.labels import Labels

POSE = {"width": 0.25, "batch_norm": True, "loss": "cross_entropy", "sigma_px": 1.0, "batch_size": 4, "device": "cpu"}
SMALL = {"num_steps": 3, "batch_size": 4, "device": "cpu"}


def frames_of(count, size=24):
    return np.random.default_rng(0).integers(0, 256, (count, size, size, 3)).astype(np.uint8)


def points(count, num_joints=2):
    joints = np.random.default_rng(1).uniform(2, 22, (count, num_joints, 2)).astype(np.float32)
    return Labels(("",) * count, np.zeros(count, np.int64), joints, np.ones((count, num_joints), bool), "points")


def bodies(count, pose=None):
    smpl_pose = np.zeros((count, 72), np.float32)
    smpl_pose[:, 0] = np.pi
    return Labels(
        ("",) * count,
        np.arange(count),
        smpl_pose=smpl_pose if pose is None else pose,
        smpl_betas=np.zeros((count, 10), np.float32),
        smpl_transl=np.tile(np.array([0, 0.2, 3], np.float32), (count, 1)),
        intrinsics=np.tile(np.array([40, 40, 12, 12], np.float32), (count, 1)),
    )


def train(module, frames, labels, options, tmp_path, name="model", **more):
    history = module.train(frames, labels, options, seed=0, out=tmp_path / name, work=tmp_path / f"{name} work", **more)
    assert np.isfinite(history.loss).all()
    return tmp_path / name


def weights(folder):
    return (folder / "model.safetensors").read_bytes()


@pytest.mark.parametrize(
    ("module", "options", "labels"),
    [
        (pose2d, pose2d.Options(**POSE, num_steps=3), points(1)),
        (smpl_regressor, smpl_regressor.Options(**SMALL), bodies(1)),
        (classifier, classifier.Options(**SMALL), Labels(("a", "b"), np.arange(2))),
    ],
    ids=["pose2d", "smpl_regressor", "classifier"],
)
def test_one_sample_is_enough_to_train_on(tmp_path, module, options, labels):
    """Of each class, for the classifier."""
    model = train(module, frames_of(len(labels)), labels, options, tmp_path)
    for values in module.predict(model, frames_of(3)).values():
        assert values.dtype.kind == "U" or np.isfinite(values).all()


@pytest.mark.parametrize(
    ("module", "options", "labels", "message"),
    [
        (pose2d, pose2d.Options(**POSE), points(0), "no joint of any of the 0 rows"),
        (smpl_regressor, smpl_regressor.Options(**SMALL), bodies(0), "0 frames but 0 labels"),
        (classifier, classifier.Options(**SMALL), Labels((), np.zeros(0, np.int64)), "two classes, got no rows"),
    ],
    ids=["pose2d", "smpl_regressor", "classifier"],
)
def test_no_rows_to_learn_from_are_refused(tmp_path, module, options, labels, message):
    with pytest.raises(DataError, match=message):
        train(module, frames_of(0), labels, options, tmp_path)


def test_one_image_a_batch_needs_more_than_one_value_a_channel(tmp_path):
    """Batch normalisation of one number has no spread: the shape of the last feature map decides."""
    labels = Labels(("a", "b"), np.arange(2))
    options = classifier.Options(num_steps=2, batch_size=1, device="cpu")
    with pytest.raises(DataError, match=r"one image of 32 x 32 px .* expected a batch_size of 2 or more"):
        train(classifier, frames_of(2, 32), labels, options, tmp_path)
    train(classifier, frames_of(2, 33), labels, options, tmp_path)
    with pytest.raises(DataError, match="expected a batch_size of 2 or more"):
        train(smpl_regressor, frames_of(2), bodies(2), smpl_regressor.Options(**{**SMALL, "batch_size": 1}), tmp_path)


@pytest.mark.parametrize("loss", ["mse", "cross_entropy"])
def test_rows_without_a_visible_joint_carry_no_loss(tmp_path, loss):
    """Whatever stands in their labels; and a batch of such rows alone has a loss of 0 and a gradient of 0."""
    labels, frames = points(8), frames_of(8)
    assert labels.joints2d is not None and labels.visible is not None
    visible = labels.visible.copy()
    visible[:6] = False
    found = []
    for hidden in (np.nan, 3.0):
        joints = labels.joints2d.copy()
        joints[:6] = hidden
        options = pose2d.Options(**{**POSE, "loss": loss}, num_steps=6)
        model = train(pose2d, frames, replace(labels, joints2d=joints, visible=visible), options, tmp_path, str(hidden))
        found.append(weights(model))
    assert found[0] == found[1]
    heatmaps = torch.randn(2, 2, 24, 24, requires_grad=True)
    nothing = torch.zeros(2, 2, dtype=torch.bool)
    value = pose2d._heatmap_loss(heatmaps, torch.zeros(2, 2, 2), nothing, pose2d.Options(loss=loss))
    value.backward()
    assert value == 0 and heatmaps.grad is not None and not heatmaps.grad.any()


def test_labels_that_are_not_numbers_are_refused_by_row(tmp_path):
    labels = points(5)
    assert labels.joints2d is not None
    joints = labels.joints2d.copy()
    joints[3, 1, 0] = np.nan
    with pytest.raises(DataError, match="joint 1 of row 3 is marked visible but its position is"):
        train(pose2d, frames_of(5), replace(labels, joints2d=joints), pose2d.Options(**POSE), tmp_path)
    for name in ("smpl_pose", "smpl_betas", "smpl_transl", "intrinsics"):
        good = bodies(5)
        array = getattr(good, name).copy()
        array[2, -1] = np.inf
        with pytest.raises(DataError, match=f"{name} of row 2 is not finite"):
            options = smpl_regressor.Options(**SMALL)
            train(smpl_regressor, frames_of(5), replace(good, **{name: array}), options, tmp_path)


def half_turns(count=8):
    """Bodies of which every joint is turned by pi, as exactly as float32 can say, about axes of all kinds."""
    axes = np.random.default_rng(2).normal(size=(count, 24, 3))
    axes[0], axes[1], axes[2], axes[3] = (1, 0, 0), (0, -1, 0), (0, 0, 1), (1, -1, 0)
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    return (np.pi * axes).reshape(count, 72).astype(np.float32)


def test_rotations_by_pi_survive_six_numbers():
    matrices = matrix_from_axis_angle(half_turns().reshape(-1, 24, 3).astype(np.float64))
    through = matrix_from_rotation_6d(rotation_6d_from_matrix(torch.from_numpy(matrices))).numpy()
    np.testing.assert_allclose(through, matrices, atol=1e-15)
    np.testing.assert_allclose(np.trace(through, axis1=-2, axis2=-1), -1, atol=1e-6)


def test_training_on_rotations_by_pi_stays_finite(tmp_path):
    labels = bodies(8, half_turns())
    model = train(smpl_regressor, frames_of(8), labels, smpl_regressor.Options(**SMALL), tmp_path)
    pose = smpl_regressor.predict(model, frames_of(8))["smpl_pose"].reshape(8, 24, 3)
    assert np.isfinite(pose).all() and (np.linalg.norm(pose, axis=-1) <= np.pi + 1e-5).all()


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.5, 3.0, np.pi - 1e-4, np.pi])
def test_angle_between_rotations_is_the_one_they_were_turned_by(angle):
    start = torch.from_numpy(matrix_from_axis_angle(np.random.default_rng(4).normal(size=(20, 3))))
    axes = np.random.default_rng(5).normal(size=(20, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    turned = (start @ torch.from_numpy(matrix_from_axis_angle(angle * axes))).requires_grad_()
    found = smpl_regressor._angles(turned, start)
    (gradient,) = torch.autograd.grad(found.sum(), turned)
    np.testing.assert_allclose(found.detach().numpy(), angle, atol=1e-12)
    assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("rotation_loss", ["chordal", "geodesic"])
def test_a_network_that_says_exactly_pi_has_a_finite_gradient(rotation_loss):
    """The loss and the joints at the label itself, where an arc cosine would have none."""
    from ctlev_core.body.layer import load_body
    from ctlev_core.body.torch_layer import BodyLayer
    from ctlev_core.networks.smpl_regressor import SmplBodies

    labels = bodies(8, half_turns())
    rotations = torch.from_numpy(matrix_from_axis_angle(half_turns().reshape(-1, 24, 3))).float()
    betas, transl, intrinsics = (
        torch.from_numpy(np.array(array)) for array in (labels.smpl_betas, labels.smpl_transl, labels.intrinsics)
    )
    six = rotation_6d_from_matrix(rotations).requires_grad_()
    body = BodyLayer(load_body())
    for offset in (0.0, 1e-4):
        found = SmplBodies(matrix_from_rotation_6d(six + offset), betas, transl + offset)
        wanted = [rotations, betas, transl, intrinsics]
        loss = smpl_regressor._loss(found, wanted, body, 24, smpl_regressor.Options(rotation_loss=rotation_loss))
        (gradient,) = torch.autograd.grad(loss, six)
        assert torch.isfinite(loss) and torch.isfinite(gradient).all()


def test_a_class_that_training_never_showed_is_an_error_and_no_crash(tmp_path):
    model = train(classifier, frames_of(4), Labels(tuple("abab"), np.arange(4)), classifier.Options(**SMALL), tmp_path)
    predicted = classifier.predict(model, frames_of(6))
    assert predicted["classes"].tolist() == ["a", "b"]
    target = Labels(tuple("aabbzz"), np.arange(6))
    scores = classification.compute(predicted, target, classification.Options())
    assert scores["accuracy"] <= 4 / 6 and all(np.isfinite(list(scores.values())))
    rows = classification.compute_rows(predicted, target, classification.Options())
    assert rows[4:].tolist() == [0, 0]


def test_every_model_takes_sets_groups_and_half_precision(tmp_path):
    """Mixing and rows held back reach the loop; the weights differ from those of one pool."""
    cases = (
        (pose2d, {**POSE, "num_steps": 4}, points(12)),
        (smpl_regressor, {**SMALL, "num_steps": 4}, bodies(12)),
        (classifier, {**SMALL, "num_steps": 4}, Labels(tuple("ab") * 6, np.arange(12))),
    )
    for module, options, labels in cases:
        given = {"parts": (8, 4), "groups": [f"s{row // 2}" for row in range(12)]}
        plain = train(module, frames_of(12), labels, module.Options(**options), tmp_path, f"{module.NAME} plain")
        more = {"mixing": 0.25, "validation_share": 0.25, "validation_every": 2, "precision": "bfloat16"}
        chosen = module.Options(**options, **more)
        mixed = train(module, frames_of(12), labels, chosen, tmp_path, f"{module.NAME} mixed", **given)
        assert weights(plain) != weights(mixed)
        same = train(module, frames_of(12), labels, module.Options(**options), tmp_path, f"{module.NAME} pool", **given)
        assert weights(plain) == weights(same), "without the options, sets and groups change nothing"


@pytest.mark.parametrize("module", [pose2d, classifier, smpl_regressor], ids=lambda module: module.NAME)
def test_channels_last_is_the_same_training_but_for_rounding(tmp_path, module):
    labels = {"pose2d": points(8), "classifier": Labels(tuple("ab") * 4, np.arange(8)), "smpl_regressor": bodies(8)}
    options = POSE if module is pose2d else SMALL
    found = []
    for channels_last in (False, True):
        chosen = module.Options(**{**options, "num_steps": 2, "learning_rate": 1e-4}, channels_last=channels_last)
        model = train(module, frames_of(8), labels[module.NAME], chosen, tmp_path, str(channels_last))
        found.append({name: tensor.double() for name, tensor in load_file(model / "model.safetensors").items()})
    for name, tensor in found[0].items():
        # Two steps of Adam move a weight by 2e-4 at most, by its gradient's sign alone where that is rounding.
        torch.testing.assert_close(found[1][name], tensor, atol=5e-4, rtol=1e-3, msg=name)


def write_keras(path, change=None):
    """A file in the layout of DHP_CNN.model, with the weights of a random network."""
    torch.manual_seed(3)
    network = DHP19Network()
    kernels = {name.split(".")[1]: tensor.numpy() for name, tensor in network.state_dict().items()}
    with h5py.File(path, "w") as file:
        for name, kernel in (change(kernels) if change else kernels).items():
            file[f"model_weights/{name}/{name}/kernel:0"] = kernel.transpose(2, 3, 1, 0)
        file.create_group("model_weights/activation_1")
    return network


@pytest.mark.parametrize("sequence_length", [1, 3])
def test_pose_network_starts_from_the_published_file(tmp_path, sequence_length):
    network = write_keras(tmp_path / "DHP_CNN.h5")
    options = pose2d.Options(
        weights=tmp_path / "DHP_CNN.h5",
        num_steps=1,
        batch_size=1,
        learning_rate=1e-12,
        device="cpu",
        sequence_length=sequence_length,
    )
    assert pose2d.input_files(options) == [tmp_path / "DHP_CNN.h5"]
    model = train(pose2d, frames_of(2), points(2, 13), options, tmp_path)
    found = load_file(model / "model.safetensors")
    for name, tensor in network.state_dict().items():
        torch.testing.assert_close(found.pop(name), tensor)
    assert bool(found) == (sequence_length > 1) and all(name.startswith("recurrent.") for name in found)


def test_other_weights_than_the_published_ones_are_refused(tmp_path):
    path = tmp_path / "DHP_CNN.h5"
    options = pose2d.Options(weights=path, num_steps=1, batch_size=1, device="cpu")
    with pytest.raises(DataError, match="expected a Keras file, found none"):
        pose2d.input_files(options)
    with pytest.raises(DataError, match=r"need width 1, batch_norm false and output_stride 1, got 0\.5, false and 1"):
        pose2d.input_files(options.model_copy(update={"width": 0.5}))
    wrong = {
        "differs in layers.conv1.weight": lambda kernels: {n: k for n, k in kernels.items() if n != "conv1"},
        r"layers.conv2a.weight must be \[32, 16, 3, 3\], got \[31, 16": lambda kernels: {
            **kernels,
            "conv2a": kernels["conv2a"][:31],
        },
        "kernel of conv2a must be .* finite": lambda kernels: {**kernels, "conv2a": kernels["conv2a"] * np.nan},
        "holds no kernels": lambda kernels: {},
    }
    for message, change in wrong.items():
        write_keras(path, change)
        with pytest.raises(DataError, match=message):
            train(pose2d, frames_of(2), points(2, 13), options, tmp_path)
    path.write_bytes(b"no HDF5")
    with pytest.raises(DataError, match="cannot be read as weights of a Keras model"):
        train(pose2d, frames_of(2), points(2, 13), options, tmp_path)
    write_keras(path)
    with pytest.raises(DataError, match=r"layers.pred_cube.weight must be \[2, 16, 3, 3\], got \[13"):
        train(pose2d, frames_of(2), points(2, 2), options, tmp_path)
