"""Do the parts of a base model fit one another? Told by configs and shapes, before a weight is loaded."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ctlev_core.diffusion.pretrained.components import ModelFiles, ModelPart, read_json
from ctlev_core.diffusion.pretrained.model_kinds import is_flow
from data_contracts.errors import DataError

CLASSES = {
    "unet": ("UNet2DConditionModel",),
    "controlnet": ("ControlNetModel",),
    "vae": ("AutoencoderKL", "PatchAutoencoder"),
    "text_encoder": ("CLIPTextModel",),
    "text_encoder_2": ("CLIPTextModelWithProjection",),
}
PREDICTION_TYPES = ("epsilon", "v_prediction", "sample")
NUM_SIZES = 6
"""Sizes in px that Stable Diffusion XL takes beside a prompt."""
BETA_SCHEDULES = ("linear", "scaled_linear", "squaredcos_cap_v2")
"""Those that every solver of diffusers knows."""
_EXTRA_CHANNELS = {
    9: "a U-Net for inpainting: latents, masked image and mask",
    8: "a U-Net that edits images: latents and those of another image",
    7: "a U-Net that enlarges images",
    5: "a U-Net with depth maps",
}
_FURTHER_INPUTS = {
    "class_embed_type": "class labels or embeddings of images",
    "num_class_embeds": "class labels",
    "encoder_hid_dim_type": "embeddings of images",
    "time_cond_proj_dim": "the scale of guidance, as latent consistency models do",
}
"""Entries of a U-Net's config that say what it is called with beside noisy latents, time and prompt."""
_TEXT_WIDTHS = {768: "Stable Diffusion v1", 1024: "Stable Diffusion 2", 1280: "SDXL's refiner", 2048: "SDXL"}
_COPIED = ("conv_in.", "time_embedding.", "add_embedding.", "down_blocks.", "mid_block.")

logger = logging.getLogger(__name__)


def check_parts(files: ModelFiles) -> None:
    """Raise unless U-Net, autoencoder, text encoders, tokenizers, schedule and ControlNet fit one another.

    Raises:
        DataError: what does not fit, expected and got.
    """
    for part in files.parts.values():
        check_class(part, CLASSES[part.name])
    unet, vae = (files.parts[name] for name in ("unet", "vae"))
    texts = [files.parts[name] for name in ("text_encoder", "text_encoder_2") if name in files.parts]
    _check_latents(unet, vae)
    _check_further_inputs(unet)
    _check_pooled(unet, texts)
    _check_prompts(unet, texts)
    for text, tokenizer in zip(texts, (files.tokenizer, files.tokenizer_2), strict=False):
        assert tokenizer is not None
        check_tokenizer(tokenizer, text)
    check_schedule(files)
    if "controlnet" in files.parts:
        _check_controlnet(files.parts["controlnet"], unet, vae)


def check_class(part: ModelPart, known: Sequence[str]) -> None:
    """Raise `DataError` where a config names another class than those."""
    named = part.config.get("_class_name") or (part.config.get("architectures") or [None])[0]
    if named is not None and named not in known:
        what = "autoencoder" if part.name == "vae" else part.name
        raise DataError(f"{part.place}: {what} must be one of {', '.join(known)}, got {named!r}")


def shape_of(part: ModelPart, name: str) -> tuple[int, ...]:
    """Of the weight of that name, with or without the prefix that transformers gave up."""
    for candidate in (name, f"text_model.{name}"):
        if candidate in part.tensors:
            return part.tensors[candidate].shape
    raise DataError(f"{part.place}: {part.name} has no weight {name!r}; it holds {len(part.tensors)} others")


def entry_of(part: ModelPart, name: str) -> Any:
    """Of a config.

    Raises:
        DataError: there is none.
    """
    if name not in part.config:
        raise DataError(f"{part.place}: the config of {part.name} has no entry {name!r}")
    return part.config[name]


def channels_of(part: ModelPart, name: str, entry: str, axis: int) -> int:
    """A width as its weights have it; the config must agree."""
    shape, told = shape_of(part, name), entry_of(part, entry)
    told = told[0] if isinstance(told, list) else told
    if len(shape) <= axis or shape[axis] != told:
        raise DataError(f"{part.place}: config.json says {entry} {told}, weight {name} has shape {list(shape)}")
    return shape[axis]


def _check_latents(unet: ModelPart, vae: ModelPart) -> None:
    makes, takes = int(entry_of(vae, "latent_channels")), shape_of(unet, "conv_in.weight")[1]
    if takes != makes:
        what = f" ({_EXTRA_CHANNELS[takes]})" if makes == 4 and takes in _EXTRA_CHANNELS else ""
        raise DataError(
            f"{unet.place}: the U-Net takes {takes} latent channels{what}, the autoencoder of {vae.place} makes {makes}"
        )
    channels_of(unet, "conv_in.weight", "in_channels", 1)
    channels_of(unet, "conv_in.weight", "block_out_channels", 0)
    if (gives := shape_of(unet, "conv_out.weight")[0]) != makes:
        raise DataError(
            f"{unet.place}: the U-Net gives {gives} channels for latents of {makes}; expected one prediction for each, "
            "without a variance"
        )
    side = unet.config.get("sample_size")
    if not isinstance(side, int) or side <= 0:
        raise DataError(f"{unet.place}: sample_size in its config must be the side of square latents, got {side!r}")


def _check_further_inputs(unet: ModelPart) -> None:
    """Raise `DataError` where a U-Net takes more than noisy latents, time and prompt."""
    for entry, what in _FURTHER_INPUTS.items():
        value = unet.config.get(entry)
        if value not in (None, "text_proj"):  # a projection of the prompt itself
            raise DataError(
                f"{unet.place}: this U-Net takes {what} beside the prompt: expected {entry} null, got {value!r}"
            )


def _check_pooled(unet: ModelPart, texts: Sequence[ModelPart]) -> None:
    """Whether a U-Net takes the pooled embedding of a second text encoder, as wide as that makes it."""
    takes = unet.config.get("addition_embed_type")
    if takes not in (None, "text", "text_time"):
        raise DataError(f"{unet.place}: addition_embed_type must be null, text or text_time, got {takes!r}")
    if (takes == "text_time") != (len(texts) == 2):
        raise DataError(
            f"{unet.place}: this U-Net is of Stable Diffusion XL, whose second text encoder (text_encoder_2) is missing"
            if takes == "text_time"
            else f"{unet.place}: this U-Net takes one text encoder, but there is a second, {texts[1].place}"
        )
    if takes != "text_time":
        return
    pooled, sizes = (
        shape_of(texts[1], "text_projection.weight")[0],
        NUM_SIZES * entry_of(unet, "addition_time_embed_dim"),
    )
    wanted = channels_of(unet, "add_embedding.linear_1.weight", "projection_class_embeddings_input_dim", 1) - sizes
    if pooled != wanted:
        raise DataError(
            f"{unet.place}: the U-Net takes pooled embeddings {wanted} wide, the text encoder of "
            f"{texts[1].place} makes {pooled}"
        )


def _check_prompts(unet: ModelPart, texts: Sequence[ModelPart]) -> None:
    makes = sum(channels_of(text, "embeddings.token_embedding.weight", "hidden_size", 1) for text in texts)
    for part_name, tensor in unet.tensors.items():
        if part_name.endswith(".attn2.to_k.weight") and tensor.shape[-1] != makes:
            takes = tensor.shape[-1]
            raise DataError(
                f"{unet.place}: the U-Net takes prompt embeddings {takes} wide"
                f"{_known_width(takes)}, the text encoder of {' and '.join(str(text.place) for text in texts)} makes "
                f"{makes}{_known_width(makes)}"
            )


def _known_width(width: int) -> str:
    return f" ({_TEXT_WIDTHS[width]})" if width in _TEXT_WIDTHS else ""


def check_tokenizer(folder: Path, text: ModelPart) -> None:
    """Raise `DataError` unless CLIP's tokenizer is there and its tokens have embeddings."""
    whole, vocabulary = folder / "tokenizer.json", folder / "vocab.json"
    if vocabulary.is_file() and (folder / "merges.txt").is_file():
        ids = read_json(vocabulary).values()
    elif whole.is_file():
        content = read_json(whole)
        model, added = content.get("model"), content.get("added_tokens")
        vocabulary_of_model = model.get("vocab") if isinstance(model, dict) else None
        ids = list(vocabulary_of_model.values()) if isinstance(vocabulary_of_model, dict) else []
        ids += [token.get("id") for token in added if isinstance(token, dict)] if isinstance(added, list) else []
    else:
        raise DataError(f"{folder}: no tokenizer; expected vocab.json and merges.txt, or tokenizer.json")
    highest = max((number for number in ids if isinstance(number, int)), default=-1)
    check_vocabulary(folder, highest, text, "embeddings.token_embedding.weight")


def check_vocabulary(folder: Path, highest: int, text: ModelPart, embeddings: str) -> None:
    """Raise `DataError` unless token ids up to `highest` are rows of a text encoder's weight `embeddings`."""
    rows = shape_of(text, embeddings)[0]
    if not 0 <= highest < rows:
        raise DataError(f"{folder}: token ids reach {highest}, the text encoder of {text.place} has {rows} embeddings")


def check_schedule(files: ModelFiles) -> None:
    """Raise unless the scheduler config says how much noise there is at each step and what the U-Net predicts."""
    config = files.scheduler_config
    missing = [name for name in ("beta_start", "beta_end", "beta_schedule") if config.get(name) is None]
    if missing and not config.get("trained_betas"):
        raise DataError(
            f"{files.place}: its scheduler config ({config.get('_class_name')}) lacks {', '.join(missing)}; "
            "expected the noise schedule of a DDPM"
        )
    prediction = config.get("prediction_type", "epsilon")
    if prediction not in PREDICTION_TYPES:
        raise DataError(
            f"{files.place}: prediction_type must be one of {', '.join(PREDICTION_TYPES)}, got {prediction!r}"
        )
    if config.get("rescale_betas_zero_snr") and prediction == "epsilon":
        raise DataError(
            f"{files.place}: rescale_betas_zero_snr leaves no signal at the last step, where predicting the noise "
            "(epsilon) says nothing of the image; expected prediction_type v_prediction or sample"
        )
    steps = config.get("num_train_timesteps", 1000)
    if not isinstance(steps, int) or steps < 1:
        raise DataError(f"{files.place}: num_train_timesteps must be a positive whole number, got {steps!r}")
    if not config.get("trained_betas"):
        _check_betas(files.place, config)


def _check_betas(place: Path, config: Mapping[str, Any]) -> None:
    """Raise unless every solver can make the noise schedule of these."""
    if config["beta_schedule"] not in BETA_SCHEDULES:
        known = ", ".join(BETA_SCHEDULES)
        raise DataError(f"{place}: beta_schedule must be one of {known}, got {config['beta_schedule']!r}")
    for name in ("beta_start", "beta_end"):
        value = config[name]
        if not isinstance(value, int | float) or not 0 < value < 1:
            raise DataError(f"{place}: {name} must be a number between 0 and 1, got {value!r}")


def complete_schedule(files: ModelFiles) -> dict[str, Any]:
    """The scheduler config with what old ones leave unsaid, in place of the defaults of diffusers' classes.

    Early Stable Diffusion configs do not say what the network predicts: the noise. Several classes clip the images they
    predict to [-1, 1] unless told not to, which is wrong for latents.
    """
    if is_flow(files.scheduler_config):
        return dict(files.scheduler_config)
    config = {"prediction_type": "epsilon", **files.scheduler_config, "clip_sample": False, "thresholding": False}
    if files.scheduler_config.get("clip_sample"):
        logger.warning("%s: clip_sample of its scheduler config is ignored: latents go beyond [-1, 1]", files.place)
    return config


def _check_controlnet(controlnet: ModelPart, unet: ModelPart, vae: ModelPart) -> None:
    """A ControlNet is a copy of the U-Net's encoder: every weight they share has one shape."""
    copied = {name for name in unet.tensors if name.startswith(_COPIED)}
    theirs = {name for name in controlnet.tensors if name.startswith(_COPIED)}
    for name in sorted(copied & theirs):
        ours, other = unet.tensors[name].shape, controlnet.tensors[name].shape
        if ours != other:
            raise DataError(
                f"{controlnet.place}: this ControlNet is made for another U-Net: {name} is {list(other)}, "
                f"in the U-Net of {unet.place} {list(ours)}"
            )
    if copied != theirs:
        different = sorted(copied ^ theirs)
        raise DataError(
            f"{controlnet.place}: this ControlNet is made for another U-Net, or a part of it is missing: "
            f"{len(different)} weights are only in one of them, such as {different[0]}"
        )
    stages = len(entry_of(controlnet, "conditioning_embedding_out_channels"))
    levels = len(entry_of(vae, "block_out_channels"))
    if stages != levels:
        raise DataError(
            f"{controlnet.place}: the ControlNet reduces condition images {2 ** (stages - 1)} times, "
            f"the autoencoder of {vae.place} reduces images {2 ** (levels - 1)} times"
        )
    check_channel_order_of(controlnet)


def check_channel_order_of(controlnet: ModelPart) -> None:
    """Raise `DataError` unless a ControlNet's config has a channel order that there is."""
    order = controlnet.config.get("controlnet_conditioning_channel_order", "rgb")
    if order not in ("rgb", "bgr"):
        raise DataError(f"{controlnet.place}: channel order must be 'rgb' or 'bgr', got {order!r}")
