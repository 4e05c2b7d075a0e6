"""Base models of each family in small, with random weights, written by the libraries as ordinary diffusers folders."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from diffusers.models.controlnets.controlnet import ControlNetModel
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from tiny_base_model import CORPUS
from tiny_stable_diffusion import SCHEDULER, SIDE, make_models, tiny_changes, write_folder
from transformers import CLIPTextConfig, CLIPTextModel, CLIPTextModelWithProjection

from ctlev_core.diffusion.pretraining.architecture import train_tokenizer

FAMILIES = ("v1", "v2", "xl")
POOLED, SIZES = 26, 4
"""Width of XL's pooled embedding, and of each of its six sizes."""


def write_family(family: str, folder: Path) -> Path:
    """The folder of a base model with a ControlNet inside."""
    models = _make_xl() if family == "xl" else make_models(_changes(family))
    write_folder(models, folder)
    folder.with_name(f"{folder.name}-controlnet").rename(folder / "controlnet")
    if family == "v2":
        (folder / "scheduler" / "scheduler_config.json").write_text(
            json.dumps(SCHEDULER | {"_class_name": "DDIMScheduler", "prediction_type": "v_prediction"})
        )
    if family == "xl":
        models["text_encoder_2"].save_pretrained(folder / "text_encoder_2")
        train_tokenizer(CORPUS, folder / "tokenizer_2")
        index = {"_class_name": "StableDiffusionXLPipeline", "force_zeros_for_empty_prompt": True}
        (folder / "model_index.json").write_text(json.dumps(index))
    return folder


def _changes(family: str) -> dict:
    changes = tiny_changes()
    if family == "v1":
        return changes
    text = {**changes["text_encoder"], "hidden_size": 20, "projection_dim": 20, "hidden_act": "gelu"}
    more = {"cross_attention_dim": 20, "use_linear_projection": True}
    return {
        **changes,
        "text_encoder": text,
        "unet": {**changes["unet"], **more},
        "controlnet": {**changes["controlnet"], **more},
    }


def _make_xl() -> dict:
    models = make_models(tiny_changes())
    text = {"vocab_size": 600, "max_position_embeddings": 16, "num_attention_heads": 2, "intermediate_size": 24}
    common = {
        "block_out_channels": (8, 16, 16),
        "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D", "CrossAttnDownBlock2D"),
        "layers_per_block": 1, "norm_num_groups": 4, "attention_head_dim": (1, 2, 2), "use_linear_projection": True,
        "transformer_layers_per_block": (1, 1, 2), "cross_attention_dim": 32, "addition_embed_type": "text_time",
        "addition_time_embed_dim": SIZES, "projection_class_embeddings_input_dim": POOLED + 6 * SIZES,
    }  # fmt: skip
    up = ("CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "UpBlock2D")
    torch.manual_seed(1)
    models |= {
        "unet": UNet2DConditionModel(sample_size=SIDE // 8, up_block_types=up, **common),
        "controlnet": ControlNetModel(conditioning_embedding_out_channels=(4, 4, 8, 8), **common),
        "text_encoder": CLIPTextModel(CLIPTextConfig(hidden_size=12, num_hidden_layers=3, **text)),
        "text_encoder_2": CLIPTextModelWithProjection(
            CLIPTextConfig(hidden_size=20, num_hidden_layers=3, projection_dim=POOLED, hidden_act="gelu", **text)
        ),
    }
    for name, parameter in models["controlnet"].named_parameters():
        if name.startswith(("controlnet_down", "controlnet_mid", "controlnet_cond_embedding.conv_out")):
            torch.nn.init.normal_(parameter, std=0.1)  # zero at first, which would hide a mistake
    for model in models.values():
        model.eval().requires_grad_(False)
    return models
