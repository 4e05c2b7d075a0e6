"""Features of the Inception network that FID is defined with, from the state dictionary of its port to PyTorch.

For those who have `pt_inception-2015-12-05-6726825d.pth`, which pytorch-fid and torch-fidelity use, rather than the
TorchScript file of `torchscript`: the network is the same, and so are the names of scores, `fid` and `kid`. Any other
file is refused. Nothing is trained.

Source: Heusel et al., GANs Trained by a Two Time-Scale Update Rule, NeurIPS 2017 (FID).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from ctlev_core.networks import feature_extractors
from data_contracts.config import RUN_SETTING, Frozen
from data_contracts.errors import DataError
from data_contracts.file_lists import file_digest
from data_contracts.image_rows import Images

VERSION = 1
NAME = "inception"
PREDICTS = ()
_FILE = "inception.pth"


class Options(Frozen):
    """Where the file is."""

    file: Path | None = Field(
        default=None, json_schema_extra=RUN_SETTING, description="local pt_inception-2015-12-05-6726825d.pth; needed"
    )
    device: str = Field(
        default="auto", description="torch device; auto = CUDA where present", json_schema_extra=RUN_SETTING
    )


def input_files(options: Options) -> list[Path]:
    """The file.

    Raises:
        DataError: none is named, it is missing, or it is another one.
    """
    if options.file is None or not options.file.is_file():
        raise DataError(f"inception: expected option `file` to be pt_inception-2015-12-05.pth, got {options.file}")
    digest = file_digest(options.file)
    if digest != feature_extractors.INCEPTION_STATE_SHA256:
        raise DataError(
            f"{options.file}: expected the published weights, SHA-256 "
            f"{feature_extractors.INCEPTION_STATE_SHA256[:12]}, got {digest[:12]}"
        )
    return [options.file]


def features(model: Path, frames: Images, device: str = "auto") -> np.ndarray:
    """Features [N, 2048] float32 of frames [N, H, W, 3] uint8, of any size.

    Raises:
        DataError: the folder is of another model, its file has changed, or frames are no images.
    """
    from ctlev_core.networks.inception import load_inception
    from ctlev_core.supervised.models import resolve_device

    feature_extractors.read_extractor(model, NAME)
    place: Any = resolve_device(device)
    network = load_inception(model / feature_extractors.FILES_FOLDER / _FILE).to(place)
    return feature_extractors.compute_features(frames, network, place, f"features of {model}")


def _find_network(options: Options) -> tuple[str, dict[str, Path]]:
    (file,) = input_files(options)
    return "inception", {_FILE: file}


name_score = feature_extractors.naming_of(NAME)
predict = feature_extractors.prediction_of(features)
train = feature_extractors.training_of(NAME, VERSION, _find_network, features)
