"""Base models of each family in small, with random weights, written by the libraries as ordinary diffusers folders."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from diffusers.models.controlnets.controlnet import ControlNetModel
from diffusers.models.controlnets.controlnet_sd3 import SD3ControlNetModel
from diffusers.models.transformers.transformer_sd3 import SD3Transformer2DModel
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from tiny_base_model import CORPUS
from tiny_stable_diffusion import SCHEDULER, SIDE, make_models, tiny_changes, write_folder
from tokenizers import Tokenizer, models, pre_tokenizers, processors
from transformers import (
    CLIPTextConfig,
    CLIPTextModel,
    CLIPTextModelWithProjection,
    PreTrainedTokenizerFast,
    T5Config,
    T5EncoderModel,
)

from ctlev_core.diffusion.pretrained.model_kinds import FLOW_SCHEDULER
from ctlev_core.diffusion.pretrained.paths import check_base_model_folder
from ctlev_core.diffusion.pretraining.architecture import train_tokenizer
from data_contracts.errors import DataError

FAMILIES = ("v1", "v2", "xl", "sd3")
POOLED, SIZES, T5_WIDTH = 26, 4, 32
"""Width of XL's pooled embedding, of each of its six sizes, and of T5's embeddings."""


def write_family(family: str, folder: Path) -> Path:
    """The folder of a base model with a ControlNet inside."""
    if family == "sd3":
        return _write_sd3(folder)
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


def check_refusal(folder: Path, place: Path, message: str, change: Callable[[Path], object]) -> None:
    """A copy of the folder at `place`, changed, is refused with the message."""
    copy = shutil.copytree(folder, place)
    change(copy)
    with pytest.raises(DataError, match=message):
        check_base_model_folder(copy, needs_controlnet=True)
    shutil.rmtree(copy)


def with_entries(name: str, file: str = "config.json", **entries: object) -> Callable[[Path], object]:
    """A change of a folder: entries of a part's config."""

    def change(folder: Path) -> None:
        path = folder / name / file
        path.write_text(json.dumps({**json.loads(path.read_text()), **entries}))

    return change


def _write_sd3(folder: Path) -> Path:
    common = {
        "sample_size": SIDE // 8, "patch_size": 2, "in_channels": 4, "attention_head_dim": 8, "num_attention_heads": 2,
        "joint_attention_dim": T5_WIDTH, "caption_projection_dim": 16, "pooled_projection_dim": 12 + POOLED,
        "pos_embed_max_size": 8,
    }  # fmt: skip
    text = {
        "vocab_size": 600, "max_position_embeddings": 16, "num_attention_heads": 2, "intermediate_size": 24,
        "num_hidden_layers": 3,
    }  # fmt: skip
    torch.manual_seed(2)
    made: dict = {
        "transformer": SD3Transformer2DModel(
            num_layers=3, out_channels=4, qk_norm="rms_norm", dual_attention_layers=(0,), **common
        ),
        "controlnet": SD3ControlNetModel(num_layers=2, force_zeros_for_pooled_projection=False, **common),
        "vae": make_models(tiny_changes())["vae"],
        "text_encoder": CLIPTextModelWithProjection(CLIPTextConfig(hidden_size=12, projection_dim=12, **text)),
        "text_encoder_2": CLIPTextModelWithProjection(
            CLIPTextConfig(hidden_size=20, projection_dim=POOLED, hidden_act="gelu", **text)
        ),
        "text_encoder_3": T5EncoderModel(
            T5Config(vocab_size=200, d_model=T5_WIDTH, d_kv=8, num_heads=2, d_ff=32, num_layers=2)
        ),
    }
    made["vae"].register_to_config(shift_factor=0.06)
    # Nearly no noise in its posteriors: diffusers' pipeline draws condition latents from them.
    made["vae"].quant_conv.weight.data[4:] = 0
    made["vae"].quant_conv.bias.data[4:] = -30
    for layer in [*made["controlnet"].controlnet_blocks, made["controlnet"].pos_embed_input.proj]:
        torch.nn.init.normal_(layer.weight, std=0.3)  # zero at first, which would hide a mistake
    for name, model in made.items():
        model.eval().requires_grad_(False).save_pretrained(folder / name)
    for name in ("tokenizer", "tokenizer_2"):
        train_tokenizer(CORPUS, folder / name)
    _write_t5_tokenizer(folder / "tokenizer_3")
    (folder / "scheduler").mkdir()
    schedule = {"_class_name": FLOW_SCHEDULER, "num_train_timesteps": 1000, "shift": 3.0}
    (folder / "scheduler" / "scheduler_config.json").write_text(json.dumps(schedule))
    return folder


def _write_t5_tokenizer(folder: Path) -> None:
    words = sorted({word for line in CORPUS for word in line.split()})[:150]
    tokens = [
        ("<pad>", 0.0),
        ("</s>", 0.0),
        ("<unk>", 0.0),
        *((f"\u2581{word}", -float(n)) for n, word in enumerate(words)),
    ]
    tokenizer = Tokenizer(models.Unigram(tokens, unk_id=2))
    tokenizer.pre_tokenizer = pre_tokenizers.Metaspace()
    tokenizer.post_processor = processors.TemplateProcessing(single="$A </s>", special_tokens=[("</s>", 1)])
    PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token="<pad>", eos_token="</s>", unk_token="<unk>", model_max_length=512
    ).save_pretrained(folder)


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
