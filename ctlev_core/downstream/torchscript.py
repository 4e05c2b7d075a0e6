"""Features of a TorchScript file, such as the Inception network that the Frechet inception distance is defined with.

A TorchScript file is a program: loaded, it runs what it holds, which may read and write any file of the user. So only
the published Inception file runs by itself; of any other somebody must say, with `trusted`, that they know it.

Nothing is trained: the file is kept with its checksum. Distances in its features are called `fid` and `kid` only where
the checksum is that of `inception-2015-12-05.pt`; that file takes images in 0..255 and resizes them itself.

Source: Karras et al., StyleGAN2-ADA, 2020 (the file, and its argument `return_features`); Heusel et al., GANs Trained
by a Two Time-Scale Update Rule, NeurIPS 2017 (FID).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from ctlev_core.networks import feature_extractors
from data_contracts.config import RUN_SETTING, Frozen
from data_contracts.errors import DataError
from data_contracts.file_lists import file_digest
from data_contracts.image_rows import Images

VERSION = 1
NAME = "torchscript"
PREDICTS = ()
_FILE = "network.pt"
_CHANNELS = {"0..1": ((0.0,) * 3, (1.0,) * 3), "imagenet": ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))}


class Options(Frozen):
    """Which file, and what it wants to see."""

    file: Path | None = Field(
        default=None,
        json_schema_extra=RUN_SETTING,
        description="local TorchScript file: images [N, 3, H, W] to features [N, D]; needed",
    )
    architecture: str = Field(
        default="torchscript", pattern=r"^[a-z0-9]+$", description="what scores call it: fd_event_ARCHITECTURE_SHA8"
    )
    values: Literal["0..255", "0..1", "imagenet"] = Field(
        default="0..255", description="range of its input; imagenet = ImageNet's mean and standard deviation taken off"
    )
    image_size: int = Field(
        default=0, ge=0, description="images are squeezed to so many px a side (bicubic, antialiased); 0 = as they are"
    )
    trusted: bool = Field(
        default=False,
        json_schema_extra=RUN_SETTING,
        description="run the program in a file other than FID's Inception; it may read and write any file of yours",
    )
    device: str = Field(
        default="auto", description="torch device; auto = CUDA where present", json_schema_extra=RUN_SETTING
    )


def input_files(options: Options) -> list[Path]:
    """The file.

    Raises:
        DataError: none is named, it is missing, it is the published Inception with a preprocessing not its own, or
            another one that nobody has said to trust.
    """
    if options.file is None or not options.file.is_file():
        raise DataError(f"torchscript: expected option `file` to be a TorchScript file, got {options.file}")
    is_inception = _is_inception(options.file)
    if not (is_inception or options.trusted):
        raise DataError(
            f"{options.file}: is not FID's Inception of known checksum; a TorchScript file is a program that may read "
            "and write any file of yours: if you know where it is from, set the option trusted=true"
        )
    if (options.values, options.image_size) != ("0..255", 0) and is_inception:
        raise DataError(
            f"{options.file} is the Inception network of FID, which takes 0..255 and resizes by itself; "
            f"expected values 0..255 and image_size 0, got {options.values} and {options.image_size}"
        )
    return [options.file]


def features(model: Path, frames: Images, device: str = "auto") -> np.ndarray:
    """Features [N, D] float32 of frames [N, H, W, 3] uint8.

    Raises:
        DataError: the folder is of another model, the file is not TorchScript, or does not make features of frames.
    """
    import torch

    from ctlev_core.supervised.models import resolve_device

    config = feature_extractors.read_extractor(model, NAME)
    options, path, place = Options(**config["options"]), model / feature_extractors.FILES_FOLDER / _FILE, device
    try:
        network: Any = torch.jit.load(path, map_location=resolve_device(place)).eval()
    except (RuntimeError, ValueError) as error:
        raise DataError(f"{path}: cannot be loaded as TorchScript: {error}") from error
    arguments = {argument.name for argument in network.forward.schema.arguments}
    extra = {"return_features": True} if "return_features" in arguments else {}

    def run(images: torch.Tensor) -> torch.Tensor:
        images = feature_extractors.resize_images(images, options.image_size)
        if options.values in _CHANNELS:
            images = feature_extractors.normalise(images, *_CHANNELS[options.values])
        return network(images, **extra)

    return feature_extractors.compute_features(frames, run, resolve_device(place), f"features of {path.parent.parent}")


def _find_network(options: Options) -> tuple[str, dict[str, Path]]:
    (file,) = input_files(options)
    return "inception" if _is_inception(file) else options.architecture, {_FILE: file}


def _is_inception(path: Path) -> bool:
    return file_digest(path) == feature_extractors.INCEPTION_SHA256


name_score = feature_extractors.naming_of(NAME)
predict = feature_extractors.prediction_of(features)
train = feature_extractors.training_of(NAME, VERSION, _find_network, features)
