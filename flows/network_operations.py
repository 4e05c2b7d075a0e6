"""Operations of base models, counted by torch on networks without weights: no data, no memory, a few seconds.

Counted are multiplications and additions of matrix products, convolutions and attention, an image at a time, also of
the backward pass where networks learn. A base model that cannot be read counts as Stable Diffusion v1.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ctlev_core.diffusion.pretrained.components import ModelPart, read_json
from ctlev_core.diffusion.pretrained.paths import find_controlnet, read_controlnet, read_parts
from ctlev_core.diffusion.pretrained.single_file import CONFIGS
from data_contracts.errors import DataError

if TYPE_CHECKING:
    from torch import Tensor

CLIP_TOKENS = 77
Work = Literal["denoising", "tune unet", "tune controlnet", "tune both", "encoding", "decoding"]


@dataclass(frozen=True)
class Networks:
    """The networks of a base model.

    Attributes:
        configs: by part, as text, so that counts can be kept: `unet` (also a transformer), `vae`, perhaps `controlnet`.
        weights: numbers of weights by part.
    """

    configs: tuple[tuple[str, str], ...]
    weights: Mapping[str, int]

    def __hash__(self) -> int:
        return hash(self.configs)

    def operations(self, work: Work, width: int, height: int) -> float:
        """Of an image of width x height px: denoising with all networks, training them, encoding or decoding."""
        return _count(self.configs, work, width, height)

    @property
    def latent_channels(self) -> int:
        """Of the autoencoder."""
        return int(json.loads(dict(self.configs)["vae"])["latent_channels"])


def learning(tune: str) -> Work:
    """The work of a training where the networks that `tune` names learn."""
    return "tune both" if tune == "both" else "tune controlnet" if tune == "controlnet" else "tune unet"


@functools.cache
def read_networks(base_model: Path, controlnet: Path | None, with_controlnet: bool) -> Networks | None:
    """Of files on disk, of which configs and the shapes of weights are read; None where that fails."""
    try:
        parts = dict(read_parts(base_model).parts)
        place = find_controlnet(base_model, controlnet) if with_controlnet else None
        if place is not None:
            parts["controlnet"] = read_controlnet(place)
        elif not with_controlnet:
            parts.pop("controlnet", None)
    except (DataError, OSError):
        return None
    counted = ("unet", "vae", "controlnet")
    configs = {name: json.dumps(part.config, sort_keys=True) for name, part in parts.items() if name in counted}
    return Networks(tuple(sorted(configs.items())), {name: _weights_of(part) for name, part in parts.items()})


@functools.cache
def stable_diffusion_v1(with_controlnet: bool) -> Networks:
    """The networks of Stable Diffusion v1, whose configs are bundled, and their numbers of weights."""
    names = ("unet", "vae", "controlnet") if with_controlnet else ("unet", "vae")
    configs = {name: json.dumps(read_json(CONFIGS)[name], sort_keys=True) for name in names}
    weights = {"unet": 859_520_964, "vae": 83_653_863, "text_encoder": 123_060_480}
    return Networks(tuple(configs.items()), weights | ({"controlnet": 361_279_120} if with_controlnet else {}))


def _weights_of(part: ModelPart) -> int:
    return sum(math.prod(tensor.shape) for tensor in part.tensors.values())


@functools.cache
def _count(configs: tuple[tuple[str, str], ...], work: Work, width: int, height: int) -> float:
    import torch
    from torch.utils.flop_counter import FlopCounterMode

    parts = {name: json.loads(config) for name, config in configs}
    with torch.device("meta"):
        vae = parts["vae"]
        scale = 2 ** (len(vae["block_out_channels"]) - 1)
        latents = torch.empty(1, vae["latent_channels"], height // scale, width // scale)
        wanted = ["vae"] if work in ("encoding", "decoding") else [name for name in parts if name != "vae"]
        models = {name: _without_weights(name, config) for name, config in configs if name in wanted}
        for name, model in models.items():
            model.requires_grad_(work in ("tune both", f"tune {name}"))
        with FlopCounterMode(display=False) as counter:
            if work == "encoding":
                models["vae"].encode(torch.empty(1, 3, height, width))
            elif work == "decoding":
                models["vae"].decode(latents)
            else:
                _denoise(models, latents, width, height, learning=work != "denoising")
    return float(counter.get_total_flops())


@functools.cache
def _without_weights(name: str, config: str) -> Any:
    from ctlev_core.diffusion.pretrained.model_building import make_model

    return make_model(ModelPart(name, Path(name), json.loads(config), {}))


def _denoise(models: Mapping[str, Any], latents: Tensor, width: int, height: int, *, learning: bool) -> None:
    import torch

    from ctlev_core.diffusion.denoising import Denoiser
    from ctlev_core.diffusion.pretrained.model_kinds import is_transformer

    unet, controlnet = models["unet"], models.get("controlnet")
    conditions = None
    if controlnet is not None:
        conditions = torch.empty_like(latents) if is_transformer(unet) else torch.empty(1, 3, height, width)
    with torch.set_grad_enabled(learning):
        predicted = Denoiser(unet, controlnet).predict(latents, torch.zeros(1), _prompt(unet), conditions)
    if learning:
        predicted.sum().backward()


def _prompt(unet: Any) -> Tensor:
    """Embeddings [1, L, D], as `encode_prompts` would make them."""
    import torch

    from ctlev_core.diffusion.pretrained.model_kinds import is_transformer
    from ctlev_core.diffusion.pretrained.prompts import T5_TOKENS, num_further_values

    if is_transformer(unet):
        width, tokens = unet.config.joint_attention_dim, CLIP_TOKENS + T5_TOKENS
    else:
        width, tokens = unet.config.cross_attention_dim, CLIP_TOKENS
    return torch.empty(1, tokens + -(-num_further_values(unet) // width), width)
