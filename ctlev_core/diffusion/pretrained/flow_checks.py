"""Do the parts of a transformer with flow matching, Stable Diffusion 3, fit one another? As `checks` for U-Nets."""

from __future__ import annotations

from pathlib import Path

from ctlev_core.diffusion.pretrained.checks import (
    channels_of,
    check_class,
    check_tokenizer,
    check_vocabulary,
    entry_of,
    shape_of,
)
from ctlev_core.diffusion.pretrained.components import ModelFiles, ModelPart, read_json
from ctlev_core.diffusion.pretrained.model_kinds import FLOW_SCHEDULER, TRANSFORMER, is_flow
from data_contracts.errors import DataError

CLASSES = {
    "controlnet": ("SD3ControlNetModel",),
    "vae": ("AutoencoderKL",),
    "text_encoder": ("CLIPTextModelWithProjection",),
    "text_encoder_2": ("CLIPTextModelWithProjection",),
    "text_encoder_3": ("T5EncoderModel",),
}
_PATCHES = "pos_embed.proj.weight"


def check_transformer_class(part: ModelPart) -> None:
    """Raise `DataError` unless it is the transformer of Stable Diffusion 3."""
    if (got := part.config.get("_class_name")) != TRANSFORMER:
        raise DataError(f"{part.place}: of transformers expected {TRANSFORMER} (Stable Diffusion 3), got {got!r}")


def check_flow_parts(files: ModelFiles) -> None:
    """Raise unless transformer, autoencoder, text encoders, tokenizers, schedule and ControlNet fit one another.

    Raises:
        DataError: what does not fit, expected and got.
    """
    network = files.parts["unet"]
    check_transformer_class(network)
    for name, part in files.parts.items():
        if name in CLASSES:
            check_class(part, CLASSES[name])
    _check_latents(network, files.parts["vae"])
    _check_prompts(files)
    _check_schedule(files)
    if "controlnet" in files.parts:
        _check_controlnet(files.parts["controlnet"], network)


def _check_latents(network: ModelPart, vae: ModelPart) -> None:
    makes, takes = int(entry_of(vae, "latent_channels")), channels_of(network, _PATCHES, "in_channels", 1)
    if takes != makes:
        raise DataError(
            f"{network.place}: the transformer takes {takes} latent channels, the autoencoder of {vae.place} makes "
            f"{makes}"
        )
    patch, side = channels_of(network, _PATCHES, "patch_size", 2), network.config.get("sample_size")
    most = patch * int(entry_of(network, "pos_embed_max_size"))
    if not isinstance(side, int) or side <= 0 or side % patch or side > most:
        raise DataError(
            f"{network.place}: sample_size in its config must be the side of square latents, a multiple of patch_size "
            f"{patch} of at most {most}, got {side!r}"
        )


def _check_prompts(files: ModelFiles) -> None:
    network = files.parts["unet"]
    clips = [files.parts["text_encoder"], files.parts["text_encoder_2"]]
    width = channels_of(network, "context_embedder.weight", "joint_attention_dim", 1)
    makes = sum(channels_of(clip, "embeddings.token_embedding.weight", "hidden_size", 1) for clip in clips)
    if makes > width:
        raise DataError(f"{network.place}: it takes prompt embeddings {width} wide, the CLIP encoders make {makes}")
    pooled = sum(shape_of(clip, "text_projection.weight")[0] for clip in clips)
    name = "time_text_embed.text_embedder.linear_1.weight"
    wanted = channels_of(network, name, "pooled_projection_dim", 1)
    if pooled != wanted:
        raise DataError(f"{network.place}: it takes pooled embeddings {wanted} wide, the CLIP encoders make {pooled}")
    for clip, tokenizer in zip(clips, (files.tokenizer, files.tokenizer_2), strict=True):
        assert tokenizer is not None
        check_tokenizer(tokenizer, clip)
    if files.tokenizer_3 is not None:
        _check_t5(files.parts["text_encoder_3"], files.tokenizer_3, width, network)


def _check_t5(part: ModelPart, tokenizer: Path, width: int, network: ModelPart) -> None:
    makes = channels_of(part, "shared.weight", "d_model", 1)
    if makes != width:
        raise DataError(f"{network.place}: it takes prompt embeddings {width} wide, T5 of {part.place} makes {makes}")
    file = tokenizer / "tokenizer.json"
    if not file.is_file():
        raise DataError(f"{tokenizer}: no tokenizer; expected tokenizer.json")
    model = read_json(file).get("model")
    tokens = model.get("vocab") if isinstance(model, dict) else None
    check_vocabulary(tokenizer, len(tokens) - 1 if isinstance(tokens, list | dict) else -1, part, "shared.weight")


def _check_schedule(files: ModelFiles) -> None:
    config = files.scheduler_config
    if not is_flow(config):
        raise DataError(
            f"{files.place}: the scheduler of a transformer must be a {FLOW_SCHEDULER}, got {config.get('_class_name')}"
        )
    if config.get("use_dynamic_shifting"):
        raise DataError(f"{files.place}: use_dynamic_shifting, a shift that depends on the image size, is not known")
    steps, shift = config.get("num_train_timesteps", 1000), config.get("shift", 1.0)
    if not isinstance(steps, int) or steps < 1:
        raise DataError(f"{files.place}: num_train_timesteps must be a positive whole number, got {steps!r}")
    if not isinstance(shift, int | float) or not shift > 0:
        raise DataError(f"{files.place}: shift of the scheduler must be a positive number, got {shift!r}")


def _check_controlnet(controlnet: ModelPart, network: ModelPart) -> None:
    if (
        controlnet.config.get("joint_attention_dim") is None
        or controlnet.config.get("pos_embed_type", "sincos") is None
    ):
        raise DataError(
            f"{controlnet.place}: this ControlNet takes neither prompt nor positions, as those of Stable Diffusion 3.5 "
            "Large; expected one as of Stable Diffusion 3"
        )
    if controlnet.config.get("extra_conditioning_channels"):
        raise DataError(f"{controlnet.place}: this ControlNet takes a mask beside its image, as for inpainting")
    for name in (_PATCHES, "context_embedder.weight", "time_text_embed.text_embedder.linear_1.weight"):
        ours, other = shape_of(network, name), shape_of(controlnet, name)
        if ours != other:
            raise DataError(
                f"{controlnet.place}: this ControlNet is made for another transformer: {name} is {list(other)}, in the "
                f"transformer of {network.place} {list(ours)}"
            )
    own, whole = entry_of(controlnet, "num_layers"), entry_of(network, "num_layers")
    if not 1 <= own <= whole:
        raise DataError(f"{controlnet.place}: expected 1 to {whole} layers, as the transformer has, got {own}")
