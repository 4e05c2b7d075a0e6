"""Object classification from one event image: a ResNet, or for images of some 32 px a small CNN.

The paper trains a pre-trained ResNet-34 with a randomly initialised MLP head (N-ImageNet, its Table 1). The default
here is a ResNet-10 of a quarter of the width from random weights, which two CPU cores train in a minute;
`architecture="resnet34"`, a `head_width` and a folder of `weights` (microsoft/resnet-34) give the paper's model.
The class list is the sorted list of the classes in the training labels.

The paper's Table 5 trains binary classifiers: `binary` makes one network of each class, which tells it from the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from ctlev_core.networks.resnet_files import ARCHITECTURES, SMALL_CNN, check_batch, check_resnet_folder
from ctlev_core.supervised.binary_tasks import Negatives, is_binary, predict_each, train_each
from ctlev_core.supervised.options import SupervisedOptions
from data_contracts.config import ADDED_LATER, RUN_SETTING, cache_material
from data_contracts.errors import DataError
from data_contracts.image_rows import Images
from data_contracts.labels import History, Labels

if TYPE_CHECKING:
    import torch

VERSION = 2
NAME = "classifier"
PREDICTS = ("classes",)


class Options(SupervisedOptions):
    """Network and training budget."""

    architecture: Literal["small-cnn", "resnet10-quarter", "resnet10-half", "resnet18", "resnet34"] = Field(
        default="resnet10-quarter",
        description="the paper's is resnet34; small-cnn is for images of some 32 px, which a ResNet shrinks to one",
    )
    head_width: int = Field(
        default=0, ge=0, description="hidden units of the head, 0 = linear; the paper gives no width"
    )
    weights: Path | None = Field(
        default=None,
        json_schema_extra=RUN_SETTING,
        description="local folder (config.json, model.safetensors) of a published ResNet of this architecture to start "
        "from, such as microsoft/resnet-34; null = random weights",
    )
    learning_rate: float = Field(default=2e-3, gt=0, description="peak of AdamW's learning rate")
    flip: bool = Field(default=False, description="mirror half of the training images")
    by_recording: bool = Field(
        default=False,
        description="a recording has the mean of the probabilities of its frames: where a recording is cut into "
        "windows, scores are then by recording",
    )
    binary: Negatives | None = Field(
        default=None,
        json_schema_extra=ADDED_LATER,
        description="one network of each class, that tells it from the others, as in the paper's Table 5; it learns "
        "from all frames of other classes, or from as many as there are of its own (balanced); null = one network of "
        "all classes",
    )


def input_files(options: Options) -> list[Path]:
    """The files of the published ResNet to start from, if any.

    Raises:
        DataError: one is missing, or they are of another network.
    """
    if options.weights and options.architecture == SMALL_CNN:
        raise DataError(f"downstream 'classifier': {SMALL_CNN} has no published weights, got weights={options.weights}")
    return check_resnet_folder(options.weights, options.architecture) if options.weights else []


def train(
    frames: Images,
    labels: Labels,
    options: Options,
    *,
    seed: int,
    out: Path,
    work: Path,
    parts: Sequence[int] = (),
    groups: Sequence[str] = (),
) -> History:
    """Train on frames with class names and write `model.safetensors` and `config.json` to `out`.

    With `binary` there is a folder with both of each class (`ctlev_core.supervised.binary_tasks`).

    Args:
        frames: [N, H, W, 3] uint8.
        labels: N rows with class names, at least two different ones.
        options: see `Options`.
        seed: of the initial weights, the order of the samples, the augmentation and dropout.
        out: model folder.
        work: folder of the resumable state.
        parts: rows of each training set, in order; empty = one set.
        groups: N subjects or recordings, held back whole for validation; empty = each row is its own.
    Returns:
        The training loss per logged step, and the loss of rows held back.
    Raises:
        DataError: numbers of rows disagree, a class name is empty, there is one class only, or the weights do not fit.
    """
    import torch

    from ctlev_core.supervised import models
    from ctlev_core.supervised.batches import plan_rows
    from ctlev_core.supervised.loop import train_model

    classes, targets = _check_training_set(frames, labels, options)
    if options.binary is not None:
        train_one = partial(train, options=options.model_copy(update={"binary": None}), seed=seed)
        return train_each(
            train_one, frames, labels, classes, options.binary,
            seed=seed, out=out, work=work, parts=parts, groups=groups,
        )  # fmt: skip
    rows = plan_rows(len(frames), options, seed=seed, parts=parts, groups=groups, classes=targets)
    weights = models.file_digests(input_files(options))
    device = models.resolve_device(options.device)
    model = models.build_seeded(lambda: _build_from_options(len(classes), options), seed).to(device)

    def compute_loss(rows: np.ndarray, generator: np.random.Generator | None) -> torch.Tensor:
        batch = frames[rows]
        if options.flip and generator is not None:
            mirror = generator.random(len(rows)) < 0.5
            batch = np.where(mirror[:, None, None, None], batch[:, :, ::-1], batch)
        with models.mixed_precision(options, device):
            logits = model(_to_input(torch.from_numpy(batch).to(device)))
        return torch.nn.functional.cross_entropy(logits.float(), torch.from_numpy(targets[rows]).to(device))

    history, record = train_model(
        model,
        compute_loss,
        rows,
        options,
        seed=seed,
        work=work,
        run_digest=models.digest(NAME, VERSION, cache_material(options), weights, seed, frames, targets),
        description="train classifier",
    )
    config = {
        "model": NAME,
        "version": VERSION,
        "classes": list(classes),
        "shape": _shape(options),
        "options": cache_material(options),
        "weights": weights,
        "training": record,
    }
    models.write_model(out, model, config)
    return history


def predict(model: Path, frames: Images) -> Mapping[str, np.ndarray]:
    """Class probabilities of each frame.

    Args:
        model: folder written by `train`.
        frames: [N, H, W, 3] uint8.
    Returns:
        `probability` [N, K] float32 and `classes` [K] str, the name of each column; of binary classifiers also what
        `predict_each` adds.
    """
    if is_binary(model):
        return predict_each(lambda folder: predict(folder, frames), model)
    network, config = _read_model(model)
    probability = _run(network, lambda images: network(images).softmax(dim=-1), frames)
    classes = np.array(config["classes"])
    return {"probability": probability.reshape(len(frames), len(classes)), "classes": classes}


def predict_recordings(model: Path, frames: Images, recordings: Sequence[str]) -> Mapping[str, np.ndarray]:
    """As `predict`; a classifier trained with `by_recording` gives all N frames of a recording their mean.

    Args:
        model: folder written by `train`.
        frames: [N, H, W, 3] uint8.
        recordings: [N] the recording of each frame.
    """
    from ctlev_core.supervised import models

    if is_binary(model):
        return predict_each(lambda folder: predict_recordings(folder, frames, recordings), model)
    found = predict(model, frames)
    if not models.read_config(model, NAME)["options"]["by_recording"]:
        return found
    names, index = np.unique(np.asarray(recordings), return_inverse=True)
    sums = np.zeros((len(names), found["probability"].shape[1]))
    np.add.at(sums, index, found["probability"])
    means = sums / np.bincount(index, minlength=len(names))[:, None]
    return {**found, "probability": means[index].astype(np.float32)}


def features(model: Path, frames: Images) -> np.ndarray:
    """Pooled features [N, D] float32 in front of the head: what the Frechet distance compares.

    Raises:
        DataError: the model is one of binary classifiers, each of which has features of its own.
    """
    if is_binary(model):
        raise DataError("feature_extractor: expected a classifier of all classes, got one with option `binary`")
    network, config = _read_model(model)
    return _run(network, network.features, frames).reshape(len(frames), _num_features(config["shape"]))


def _check_training_set(frames: Images, labels: Labels, options: Options) -> tuple[tuple[str, ...], np.ndarray]:
    from ctlev_core.supervised.models import check_frames

    where = "train classifier"
    check_frames(frames, where)
    if len(labels) != len(frames):
        raise DataError(f"{where}: {len(frames)} frames but {len(labels)} labels")
    if "" in labels.class_names:
        raise DataError(f"{where}: row {labels.class_names.index('')} has no class name")
    classes = tuple(sorted(set(labels.class_names)))
    if len(classes) < 2:
        raise DataError(f"{where}: needs at least two classes, got {f'{classes[0]!r} alone' if classes else 'no rows'}")
    if options.architecture != SMALL_CNN:
        check_batch(options.batch_size, frames.shape[1], frames.shape[2], where)
    columns = {name: column for column, name in enumerate(classes)}
    return classes, np.array([columns[name] for name in labels.class_names], dtype=np.int64)


def _shape(options: Options) -> dict[str, Any]:
    return ARCHITECTURES[options.architecture]


def _build_from_options(num_classes: int, options: Options) -> Any:
    from ctlev_core.networks.resnet import load_backbone

    network = _build(_shape(options), num_classes, options.head_width)
    if options.weights:
        load_backbone(network, options.weights)
    return network


def _build(shape: dict[str, Any], num_classes: int, head_width: int) -> Any:
    from ctlev_core.networks.resnet import ResNetClassifier
    from ctlev_core.networks.small_cnn import SmallCNN

    network = SmallCNN if "widths" in shape else ResNetClassifier
    return network(shape, num_classes, head_width)


def _num_features(shape: dict[str, Any]) -> int:
    from ctlev_core.networks.small_cnn import num_features

    return num_features(shape) if "widths" in shape else shape["hidden_sizes"][-1]


def _read_model(folder: Path) -> tuple[Any, dict[str, Any]]:
    from ctlev_core.supervised import models

    config = models.read_config(folder, NAME)
    network = _build(config["shape"], len(config["classes"]), config["options"]["head_width"])
    models.read_weights(folder, network)
    return network.to(models.resolve_device("auto")), config


def _run(network: Any, function: Any, frames: Images) -> np.ndarray:
    from ctlev_core.supervised import models

    models.check_frames(frames, "predict classifier")
    batches = models.predict_in_batches(network, lambda images: function(_to_input(images)).cpu().numpy(), frames)
    return np.concatenate(batches) if batches else np.zeros(0, np.float32)


def _to_input(images: torch.Tensor) -> torch.Tensor:
    """[N, H, W, 3] uint8 -> [N, 3, H, W] float32 in [0, 1]."""
    return images.permute(0, 3, 1, 2).float() / 255
