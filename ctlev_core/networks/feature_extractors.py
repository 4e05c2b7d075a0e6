"""Ready-made networks as feature extractors: kept beside their checksums, run on event images, named in scores.

Distances between features compare only where the extractor is the same, so its checksum is part of the score's name.
`fid` and `kid` are reserved for the Inception network that those scores were defined with.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from data_contracts.config import cache_material
from data_contracts.errors import DataError
from data_contracts.file_lists import file_digest
from data_contracts.image_rows import Images
from data_contracts.labels import History, Labels

if TYPE_CHECKING:
    import torch

CONFIG_NAME = "config.json"
FILES_FOLDER = "network"
BATCH_SIZE = 32
"""Fixed, for rounding may depend on it."""
INCEPTION_SHA256 = "f58cb9b6ec323ed63459aa4fb441fe750cfe39fafad6da5cb504a16f19e958f4"
"""Of `inception-2015-12-05.pt`, the TorchScript translation of TensorFlow's Inception that StyleGAN2-ADA published."""
INCEPTION_STATE_SHA256 = "6726825d0af5f729cebd5821db510b11b1cfad8faad88a03f1befd49fb9129b2"
"""Of `pt_inception-2015-12-05-6726825d.pth`, the weights of the same network as pytorch-fid published them."""
_SCORES_OF_INCEPTION = {"fd": "fid", "kid": "kid", "fd_infinity": "fid_infinity"}


def write_extractor(
    out: Path, kind: str, version: int, architecture: str, files: Mapping[str, Path], options: dict[str, Any]
) -> None:
    """Copy the files of a network, by the names they are to have, to `out`, and write their checksums beside them.

    Copies, because a path would mean something else on another machine, or tomorrow.
    """
    (out / FILES_FOLDER).mkdir(parents=True, exist_ok=True)
    for name, path in files.items():
        shutil.copyfile(path, out / FILES_FOLDER / name)
    config = {
        "model": kind,
        "version": version,
        "architecture": architecture,
        "sha256": {name: file_digest(out / FILES_FOLDER / name) for name in sorted(files)},
        "options": options,
    }
    (out / CONFIG_NAME).write_text(json.dumps(config, indent=2, sort_keys=True) + "\n", encoding="utf-8")


def training_of(
    kind: str,
    version: int,
    find_network: Callable[[Any], tuple[str, Mapping[str, Path]]],
    features: Callable[[Path, np.ndarray, str], np.ndarray],
) -> Callable[..., History]:
    """The `train` of an extractor plug-in that is ready-made.

    Args:
        kind: name of the plug-in.
        version: of the plug-in.
        find_network: from options to what scores call the network, and its files by the names they are to have.
        features: of the plug-in.
    """

    def train(
        frames: np.ndarray,
        labels: Labels,
        options: Any,
        *,
        seed: int,
        out: Path,
        work: Path,
        parts: Sequence[int] = (),
        groups: Sequence[str] = (),
    ) -> History:
        """Keep the network's files and their checksums in `out`; nothing learns.

        Args:
            frames: [N, H, W, 3] uint8, N >= 1; the first show whether the network runs on such images.
            labels: not looked at, like `seed`, `work`, `parts` and `groups`.
            options: of the plug-in.
            seed: of nothing.
            out: model folder.
            work: stays empty.
            parts: of nothing.
            groups: of nothing.
        Returns:
            No losses.
        Raises:
            DataError: as `input_files` and `features`.
        """
        architecture, files = find_network(options)
        write_extractor(out, kind, version, architecture, files, cache_material(options))
        features(out, frames[:2], options.device)
        return History()

    return train


def naming_of(kind: str) -> Callable[[Path, str], str]:
    """The `name_score` of an extractor plug-in of that name that is ready-made."""

    def name_score_of(model: Path, score: str) -> str:
        """What a score in these features is called: see `feature_files.name_score`."""
        return name_score(score, read_extractor(model, kind))

    return name_score_of


def prediction_of(features: Callable[[Path, np.ndarray], np.ndarray]) -> Callable[..., Mapping[str, np.ndarray]]:
    """The `predict` of an extractor plug-in that is ready-made; `features` are its own."""

    def predict(model: Path, frames: np.ndarray) -> Mapping[str, np.ndarray]:
        """`features` [N, D]: there is nothing else to predict."""
        return {"features": features(model, frames)}

    return predict


def read_extractor(folder: Path, kind: str) -> dict[str, Any]:
    """The `config.json` of an extractor that `write_extractor` wrote.

    Raises:
        DataError: there is none, it is one of another kind, or a file of its network has changed.
    """
    path = folder / CONFIG_NAME
    if not path.is_file():
        raise DataError(f"{folder}: expected {CONFIG_NAME} of a {kind} extractor, found none")
    config = json.loads(path.read_text(encoding="utf-8"))
    if config.get("model") != kind:
        raise DataError(f"{folder}: expected a {kind} extractor, got {config.get('model')!r}")
    for name, expected in config["sha256"].items():
        file = folder / FILES_FOLDER / name
        got = file_digest(file) if file.is_file() else "no file"
        if got != expected:
            raise DataError(f"{file}: expected SHA-256 {expected[:12]}, got {got[:12]}")
    return config


def name_score(score: str, config: Mapping[str, Any]) -> str:
    """What a score of features may be called.

    Args:
        score: as the metric calls it, such as `fd`.
        config: from `read_extractor`, which has compared the checksums with the files.
    Returns:
        `fid` for `fd` in features of the published Inception, and SCORE_event_ARCHITECTURE_SHA8 otherwise, SHA8 the
        first 8 digits of the checksum: of the file, or of the list of checksums where there are several.
    """
    digests = config["sha256"]
    is_inception = list(digests.values()) in ([INCEPTION_SHA256], [INCEPTION_STATE_SHA256])
    if is_inception and score in _SCORES_OF_INCEPTION:
        return _SCORES_OF_INCEPTION[score]
    return f"{score}_event_{config['architecture']}_{_short_digest(digests)}"


def _short_digest(digests: Mapping[str, str]) -> str:
    import hashlib

    if len(digests) == 1:
        return next(iter(digests.values()))[:8]
    return hashlib.sha256(json.dumps(digests, sort_keys=True).encode()).hexdigest()[:8]


def compute_features(
    frames: Images, network: Callable[[torch.Tensor], torch.Tensor], device: torch.device, where: str
) -> np.ndarray:
    """Features [N, D] float32 of frames [N, H, W, 3] uint8.

    Args:
        frames: images.
        network: images [B, 3, H, W] float32 in 0..255 on `device` to features [B, D], or [B, D, 1, 1].
        device: where it runs.
        where: for errors.
    Raises:
        DataError: frames are of another shape, there are none, the network cannot run on them or makes something else
            of them, or a feature is not finite; the message names the row.
    """
    import torch

    from ctlev_core.supervised.models import check_frames

    check_frames(frames, where)
    if not len(frames):
        raise DataError(f"{where}: no frames to compute features of")
    found = []
    with torch.inference_mode():
        for start in range(0, len(frames), BATCH_SIZE):
            batch = np.ascontiguousarray(frames[start : start + BATCH_SIZE].transpose(0, 3, 1, 2))
            try:
                features = network(torch.from_numpy(batch).to(device).float())
            except RuntimeError as error:
                raise DataError(f"{where}: the network cannot run on images {list(batch.shape)}: {error}") from error
            shape = tuple(features.shape) if isinstance(features, torch.Tensor) else type(features).__name__
            if not isinstance(shape, tuple) or shape[:1] != (len(batch),) or shape[2:] not in ((), (1, 1)):
                raise DataError(f"{where}: expected features [{len(batch)}, D] of the network, got {shape}")
            found.append(features.reshape(len(batch), -1).float().cpu().numpy())
    result = np.concatenate(found)
    wrong = ~np.isfinite(result).all(axis=1)
    if wrong.any():
        raise DataError(f"{where}: the features of row {int(np.argmax(wrong))} are not finite")
    return result


def resize_images(images: torch.Tensor, size: int, mode: str = "bicubic") -> torch.Tensor:
    """Images [B, 3, H, W] squeezed to `size` x `size`, with antialiasing; nothing is cut off. 0 leaves them alone."""
    import torch

    if not size or tuple(images.shape[-2:]) == (size, size):
        return images
    return torch.nn.functional.interpolate(images, (size, size), mode=mode, antialias=True)


def normalise(images: torch.Tensor, mean: tuple[float, ...], std: tuple[float, ...]) -> torch.Tensor:
    """Images [B, 3, H, W] in 0..255 to (image / 255 - mean) / std, by channel."""
    shape = (1, 3, 1, 1)
    return (images / 255 - images.new_tensor(mean).view(shape)) / images.new_tensor(std).view(shape)
