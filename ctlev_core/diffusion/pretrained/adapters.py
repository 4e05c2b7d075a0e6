"""Checkpoints that hold what LoRA changes of a base model, and not the base model itself.

    checkpoint/
      adapter.json                              the base model, where it lies and its digest
      pytorch_lora_weights.safetensors          of the U-Net: `pipeline.load_lora_weights(checkpoint)`
      controlnet/pytorch_lora_weights.safetensors
                                                of the ControlNet: `controlnet.load_lora_adapter(folder, prefix=None)`
      scheduler/                                as in the base model

A weight W of the base model becomes W + B A, where A has few rows and B few columns (Hu et al., LoRA, ICLR 2022, with
alpha equal to the rank). Files are in the format of diffusers. Imports nothing heavy: the plan calls it.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctlev_core.diffusion.pretrained.components import read_json
from ctlev_core.diffusion.pretrained.model_kinds import is_transformer
from ctlev_core.diffusion.pretrained.paths import BUNDLED_BASE_MODEL, base_model_places
from ctlev_core.safe_files.tensor_files import read_tensor_table
from data_contracts.errors import DataError
from data_contracts.file_lists import file_digest, files_of

if TYPE_CHECKING:
    from torch import nn

ADAPTER_FILE = "adapter.json"
WEIGHTS_FILE = "pytorch_lora_weights.safetensors"
BASE_MODEL = "CTLEV_BASE_MODEL"
"""Where the base model of an adapter lies, if it is no longer where it was."""
FOLDERS = {"unet": ".", "controlnet": "controlnet"}
"""Where the weights of a network lie."""
_BUNDLED = "bundled/"


@dataclass(frozen=True)
class Adapter:
    """What belongs to an adapter.

    Attributes:
        base_model: folder or file.
        controlnet: as `load_base_model` takes it.
        networks: those that were adapted.
        digest: of the weights that were adapted.
        with_controlnet: whether condition images steer it; None = not said by an older version.
    """

    base_model: Path
    controlnet: Path | None
    networks: tuple[str, ...]
    digest: str
    with_controlnet: bool | None = None


def prefix_of(name: str, network: Any) -> str:
    """Of the names of a network's additions, as diffusers expects them; `name` is one of `FOLDERS`."""
    if name == "controlnet":
        return ""
    return "transformer." if is_transformer(network) else "unet."


def is_adapter(checkpoint: Path) -> bool:
    """Is it a folder that needs a base model?"""
    return (checkpoint / ADAPTER_FILE).is_file()


def read_adapter(checkpoint: Path) -> Adapter:
    """The base model of an adapter, found; its weights, which may be gigabytes, are not read.

    Raises:
        DataError: the description is damaged, or the base model is not there.
    """
    path = checkpoint / ADAPTER_FILE
    found = read_json(path)
    try:
        named, digest, networks = str(found["base_model"]), str(found["digest"]), tuple(found["networks"])
        controlnet = None if found["controlnet"] is None else Path(found["controlnet"])
    except (KeyError, TypeError) as error:
        raise DataError(f"{path}: expected base_model, controlnet, digest and networks: {error!r}") from error
    if not networks or not set(networks) <= set(FOLDERS):
        raise DataError(f"{path}: networks must be among {', '.join(FOLDERS)}, got {networks}")
    asked = os.environ.get(BASE_MODEL, "")
    base_model = Path(asked) if asked else _place_of(named)
    if not base_model.exists():
        raise DataError(
            f"{path}: the base model that this adapter belongs to is not at {base_model}; set {BASE_MODEL} to its place"
        )
    return Adapter(base_model, controlnet, networks, digest, found.get("with_controlnet"))


def check_base_model(checkpoint: Path, adapter: Adapter) -> None:
    """Raise `DataError` unless the base model is the one that was adapted; reads its weights."""
    got = _digest(adapter.base_model, adapter.controlnet)
    if got != adapter.digest:
        raise DataError(
            f"{checkpoint / ADAPTER_FILE}: {adapter.base_model} is not the base model that this adapter belongs to: "
            f"expected weights of digest {adapter.digest[:12]}, got {got[:12]}; set {BASE_MODEL} to the place of the "
            "right one"
        )


def write_adapter(
    checkpoint: Path, base_model: Path | None, controlnet: Path | None, networks: list[str], *, with_controlnet: bool
) -> None:
    """Say what the weights in a checkpoint folder belong to.

    Args:
        checkpoint: the folder.
        base_model: folder or file; None = the bundled one.
        controlnet: as `load_base_model` took it.
        networks: those that were adapted.
        with_controlnet: whether condition images steer it.
    """
    place = base_model or BUNDLED_BASE_MODEL
    if controlnet is not None and not (len(controlnet.parts) == 1 and (place / controlnet).is_dir()):
        controlnet = controlnet.absolute()  # elsewhere than in the base model, and found from any folder
    inside = place.parent == BUNDLED_BASE_MODEL.parent
    content: dict[str, Any] = {
        "base_model": f"{_BUNDLED}{place.name}" if inside else str(place.absolute()),
        "controlnet": None if controlnet is None else str(controlnet),
        "digest": _digest(place, controlnet),
        "networks": networks,
        "with_controlnet": with_controlnet,
    }
    (checkpoint / ADAPTER_FILE).write_text(json.dumps(content, indent=2) + "\n")


def merge_adapter(network: nn.Module, name: str, checkpoint: Path) -> None:
    """Add what the checkpoint says to the weights of a network, in place.

    Args:
        network: the base model's.
        name: `unet` or `controlnet`.
        checkpoint: the adapter's folder.
    Raises:
        DataError: weights are damaged, or do not fit the network.
    """
    import torch

    from ctlev_core.diffusion.pretrained.model_building import load_tensor

    path = checkpoint / FOLDERS[name] / WEIGHTS_FILE
    prefix = prefix_of(name, network)
    stored = {key.removeprefix(prefix): tensor for key, tensor in read_tensor_table(path).items()}
    modules = sorted(key.removesuffix(".lora_A.weight") for key in stored if key.endswith(".lora_A.weight"))
    expected = {f"{module}.lora_{part}.weight" for module in modules for part in "AB"}
    if not modules or expected != stored.keys():
        odd = sorted(expected ^ stored.keys())
        raise DataError(f"{path}: expected pairs of weights lora_A and lora_B, got {', '.join(odd[:3]) or 'none'}")
    weights = dict(network.named_parameters())
    for module in modules:
        weight = weights.get(f"{module}.weight")
        if weight is None:
            raise DataError(f"{path}: the {name} has no layer {module}")
        first, second = (
            load_tensor(stored[f"{module}.lora_{part}.weight"], torch.float32).to(weight.device) for part in "AB"
        )
        if len(second) != len(weight) or first.shape[1:] != weight.shape[1:] or second.shape[1] != len(first):
            raise DataError(
                f"{path}: {module} has the shape {list(weight.shape)}, its adapter {list(second.shape)} times "
                f"{list(first.shape)}"
            )
        with torch.no_grad():
            change = (second.flatten(1) @ first.flatten(1)).reshape(weight.shape)
            weight.copy_(weight.float() + change)


def _place_of(named: str) -> Path:
    if named.startswith(_BUNDLED):
        return BUNDLED_BASE_MODEL.with_name(named.removeprefix(_BUNDLED))
    return Path(named)


def _digest(base_model: Path, controlnet: Path | None) -> str:
    """Of all weights and configs of the base model."""
    digest = hashlib.sha256()
    for name, path in files_of(base_model_places(base_model, controlnet=controlnet)):
        digest.update(f"{name} {file_digest(path)}\n".encode())
    return digest.hexdigest()
