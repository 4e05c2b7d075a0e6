"""Train small additions to the weights of a base model in place of the weights: LoRA, by peft and diffusers.

Source: Hu et al., LoRA: Low-Rank Adaptation of Large Language Models, ICLR 2022. As in the examples of diffusers
alpha is the rank, A is drawn from a normal distribution, and B is zero, so that training starts from the base model.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from ctlev_core.diffusion.pretrained.adapters import FOLDERS, WEIGHTS_FILE, prefix_of, write_adapter
from ctlev_core.diffusion.pretrained.loading import PretrainedModel, training_scheduler
from ctlev_core.diffusion.pretrained.model_kinds import is_transformer
from ctlev_core.diffusion.training.options import FineTuningOptions

ATTENTION = ["to_q", "to_k", "to_v", "to_out.0"]
OF_PROMPTS = ["add_q_proj", "add_k_proj", "add_v_proj", "to_add_out"]
"""Attention of a transformer from and to the prompt, beside that of the image."""
LORA_STREAM = 17
MIN_CHANNELS = 5
"""A layer to or from an image or latents is small itself."""


def add_lora(networks: dict[str, Any], options: FineTuningOptions, seed: int) -> list[torch.nn.Parameter]:
    """Give each network its additions, and freeze the rest.

    Returns:
        The weights that learn; whose start is a function of the seed.
    """
    from peft import LoraConfig

    parameters = []
    for number, network in enumerate(networks.values()):
        attention = ATTENTION + OF_PROMPTS * is_transformer(network)
        layers = attention if options.lora_layers == "attention" else _layers(network)
        network.requires_grad_(False)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed * 1000 + LORA_STREAM + number)
            network.add_adapter(
                LoraConfig(
                    r=options.lora_rank or 0,
                    lora_alpha=options.lora_rank or 0,
                    init_lora_weights="gaussian",
                    target_modules=layers,
                )
            )
        parameters += [parameter for parameter in network.parameters() if parameter.requires_grad]
    return parameters


def _layers(network: Any) -> list[str]:
    """Every linear layer and convolution but the smallest."""
    kinds = (torch.nn.Linear, torch.nn.Conv2d)
    return [
        name
        for name, layer in network.named_modules()
        if isinstance(layer, kinds) and min(layer.weight.shape[:2]) >= MIN_CHANNELS
    ]


def save_lora(base_model: PretrainedModel, options: FineTuningOptions, controlnet: Path | None, folder: Path) -> None:
    """Write what was learnt to a folder; see `ctlev_core.diffusion.pretrained.adapters`."""
    from peft.utils import get_peft_model_state_dict
    from safetensors.torch import save_file

    adapted = []
    for name in FOLDERS:
        network = getattr(base_model, name)
        if not getattr(network, "peft_config", None):
            continue
        adapted.append(name)
        prefix = prefix_of(name, network)
        weights = {prefix + key: value.cpu() for key, value in get_peft_model_state_dict(network).items()}
        path = folder / FOLDERS[name] / WEIGHTS_FILE
        path.parent.mkdir(parents=True, exist_ok=True)
        # Not by diffusers, which writes a set beside them, whose order is another in each process.
        save_file({key: weights[key].contiguous() for key in sorted(weights)}, path, metadata={"format": "pt"})
    training_scheduler(base_model.scheduler_config).save_pretrained(folder / "scheduler")
    with_controlnet = base_model.controlnet is not None
    write_adapter(folder, options.base_model, controlnet, adapted, with_controlnet=with_controlnet)
