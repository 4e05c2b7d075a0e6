"""Networks from their configs and stored tensors: strict, of any precision, and never through a pickle or the network.

The libraries' own `from_pretrained` gives weights that a file lacks at random and leaves unknown ones unused, with a
warning; here both are errors. Nothing is looked up outside the files given.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from ctlev_core.diffusion.pretrained.components import ModelPart
from ctlev_core.diffusion.pretrained.model_kinds import TRANSFORMER
from ctlev_core.safe_files.tensor_files import FLOATS, StoredTensor, read_items
from data_contracts.errors import DataError

_UNUSED = (".position_ids", "position_ids")
_TIED = ("encoder.embed_tokens.weight",)


def build_model(part: ModelPart, dtype: torch.dtype) -> Any:
    """The network of a part, in evaluation mode, on the CPU.

    Args:
        part: config and stored tensors.
        dtype: of all floating-point weights in memory.
    Raises:
        DataError: the config does not make a network, or the weights are not exactly its own.
    """
    from accelerate import init_empty_weights

    try:
        with init_empty_weights():  # no memory and no time for random weights that are replaced at once
            model = make_model(part)
    except Exception as error:  # a wrong config can raise nearly any error
        raise DataError(f"{part.place}: its config does not make a {part.name}: {error}") from error
    expected = model.state_dict()
    stored = _match_names(part, expected)
    for name, tensor in stored.items():
        if tensor.shape != tuple(expected[name].shape):
            raise DataError(
                f"{part.place}: {part.name} by its config has {name} of shape {list(expected[name].shape)}, "
                f"the weights file {list(tensor.shape)}"
            )
        if expected[name].is_floating_point() and tensor.dtype not in FLOATS:
            raise DataError(f"{tensor.path}: weight {name} is of type {tensor.dtype}; expected {', '.join(FLOATS)}")
    exact = _exact_modules(model, dtype)
    loaded = {
        name: load_tensor(tensor, dtype if exact.isdisjoint(name.split(".")) else torch.float32)
        for name, tensor in stored.items()
    }
    model.load_state_dict(loaded, assign=True)
    if part.name == "text_encoder_3":
        model.tie_weights()
    return model.eval().requires_grad_(False)


def _exact_modules(model: Any, dtype: torch.dtype) -> set[str]:
    """Names of modules whose weights stay float32, as where transformers and diffusers load them in float16.

    Such are the last layers of T5's feed-forward networks, whose outputs do not fit into float16.
    """
    return set(getattr(model, "_keep_in_fp32_modules", None) or ()) if dtype == torch.float16 else set()


def make_model(part: ModelPart) -> Any:
    """The network that a part's config describes, with random weights."""
    from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
    from diffusers.models.controlnets.controlnet import ControlNetModel
    from diffusers.models.controlnets.controlnet_sd3 import SD3ControlNetModel
    from diffusers.models.transformers.transformer_sd3 import SD3Transformer2DModel
    from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel

    from ctlev_core.diffusion.patch_autoencoder import PatchAutoencoder

    if part.name == "text_encoder_3":
        from transformers import T5Config, T5EncoderModel

        return T5EncoderModel(T5Config.from_dict(part.config))
    if part.name in ("text_encoder", "text_encoder_2"):
        from transformers import CLIPTextConfig, CLIPTextModel, CLIPTextModelWithProjection

        encoder = CLIPTextModelWithProjection if _has_projection(part) else CLIPTextModel
        return encoder(CLIPTextConfig.from_dict(part.config))
    if part.config.get("_class_name") == TRANSFORMER:
        return SD3Transformer2DModel.from_config(part.config)
    if part.config.get("_class_name") == "SD3ControlNetModel":
        return SD3ControlNetModel.from_config(part.config)
    classes: dict[str, Any] = {
        "unet": UNet2DConditionModel,
        "controlnet": ControlNetModel,
        "vae": PatchAutoencoder if part.config.get("_class_name") == "PatchAutoencoder" else AutoencoderKL,
    }
    return classes[part.name].from_config(part.config)


def _has_projection(part: ModelPart) -> bool:
    return part.name == "text_encoder_2" or part.config.get("architectures") == ["CLIPTextModelWithProjection"]


def _match_names(part: ModelPart, expected: Mapping[str, Tensor]) -> dict[str, StoredTensor]:
    """The stored tensors by the names of this version of the libraries; the same set as the network's."""
    stored = {name: tensor for name, tensor in part.tensors.items() if not name.endswith(_UNUSED)}
    if part.name == "text_encoder_3" and "shared.weight" in stored:  # one weight, stored under one of its names
        stored.setdefault("encoder.embed_tokens.weight", stored["shared.weight"])
        stored = {name: tensor for name, tensor in stored.items() if name in expected or name not in _TIED}
    if part.name == "text_encoder" and not _has_projection(part):  # transformers gave up the prefix in 5.6
        prefix = "text_model." if any(name.startswith("text_model.") for name in expected) else ""
        stored = {prefix + name.removeprefix("text_model."): tensor for name, tensor in stored.items()}
    missing, unknown = sorted(expected.keys() - stored.keys()), sorted(stored.keys() - expected.keys())
    for problem, names in (("missing", missing), ("unknown", unknown)):
        if names:
            raise DataError(
                f"{part.place}: of the {len(expected)} weights of this {part.name}, {len(missing)} are missing and "
                f"{len(unknown)} others are there; {problem}: {', '.join(names[:3])}{' ...' if len(names) > 3 else ''}"
            )
    return stored


def load_tensor(stored: StoredTensor, dtype: torch.dtype) -> Tensor:
    """A copy of a stored tensor in memory; integers keep their type, floats become `dtype`."""
    items = torch.from_numpy(read_items(stored).copy())
    if stored.dtype in ("F16", "BF16"):
        items = items.view(torch.int16).view(torch.float16 if stored.dtype == "F16" else torch.bfloat16)
    tensor = items.as_strided(stored.shape, stored.strides)
    return tensor.to(dtype if tensor.is_floating_point() else tensor.dtype).contiguous()
