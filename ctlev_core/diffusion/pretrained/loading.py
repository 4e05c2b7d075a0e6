"""Load pre-trained weights: a local diffusers folder of Stable Diffusion v1, 2, XL or 3, a Stable Diffusion v1 file,
or the bundled small base model alike.

Nothing is downloaded, and no pickle is run: `docs/weights.md` says what is read and what is checked.
"""

from __future__ import annotations

import copy
import inspect
import json
import logging
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ctlev_core.diffusion.motion_layers import MotionLayers
from ctlev_core.diffusion.pretrained.adapters import check_base_model, is_adapter, merge_adapter, read_adapter
from ctlev_core.diffusion.pretrained.checks import complete_schedule
from ctlev_core.diffusion.pretrained.components import ZERO_EMPTY_PROMPT, read_json
from ctlev_core.diffusion.pretrained.model_building import build_model
from ctlev_core.diffusion.pretrained.model_kinds import is_flow, is_transformer
from ctlev_core.diffusion.pretrained.paths import BUNDLED_BASE_MODEL, read_base_model_files, read_parts
from ctlev_core.processes import use_cores_for
from data_contracts.errors import DataError

LIBRARIES = ("diffusers", "transformers")
ENCODE_PIXELS = 4 * 512**2
"""Pixels that the autoencoder encodes at once: images of 512 px take .7 GB each in Stable Diffusion's. A CPU gains
nothing from more of them, and is not told that its memory runs out before the process is killed."""
logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class PretrainedModel:
    """The parts of a latent-diffusion pipeline, in evaluation mode.

    Attributes:
        tokenizer: text to token ids.
        text_encoder: token ids to prompt embeddings [N, L, D].
        vae: images in [-1, 1] to latents and back.
        unet: predicts from noisy latents; of Stable Diffusion 3 the transformer.
        controlnet: steers the U-Net by a condition image; None where the folder has none.
        scheduler_config: the noise schedule the base model was trained with.
        image_size: (width, height) px of the images the U-Net was trained on.
        value_table: [256, 256], how values are drawn about those the networks expect; None = they are taken as they
            are.
        motion: layers that make consecutive frames from one another; None = each frame is made by itself.
        tokenizer_2: of Stable Diffusion XL and 3, as `tokenizer` for `text_encoder_2`; None = there is no second one.
        text_encoder_2: token ids to prompt embeddings and a pooled one.
        zero_empty_prompt: the empty prompt, of guidance, is zeros; else its embedding.
        tokenizer_3: of Stable Diffusion 3, as `tokenizer` for `text_encoder_3`.
        text_encoder_3: T5; None = it was left out, or there is none.
    """

    tokenizer: Any
    text_encoder: Any
    vae: Any
    unet: Any
    controlnet: Any | None
    scheduler_config: dict[str, Any]
    image_size: tuple[int, int]
    value_table: Any | None = None
    motion: MotionLayers | None = None
    tokenizer_2: Any | None = None
    text_encoder_2: Any | None = None
    zero_empty_prompt: bool = False
    tokenizer_3: Any | None = None
    text_encoder_3: Any | None = None

    @property
    def scaling_factor(self) -> float:
        """Latents are multiplied by it after encoding."""
        return float(self.vae.config.scaling_factor)

    @property
    def shift_factor(self) -> float:
        """Is taken from latents before that."""
        return float(getattr(self.vae.config, "shift_factor", None) or 0.0)

    def scale_latents(self, latents: torch.Tensor) -> torch.Tensor:
        """Latents of the autoencoder as the networks take them."""
        return (latents - self.shift_factor) * self.scaling_factor

    @property
    def reversed_condition(self) -> bool:
        """Does the ControlNet expect its condition image as BGR?"""
        if self.controlnet is None:
            return False
        return getattr(self.controlnet.config, "controlnet_conditioning_channel_order", "rgb") == "bgr"


def choose_device(name: str) -> torch.device:
    """`auto` is the first CUDA device where there is one, else the CPU."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return torch.device(name)


def load_base_model(
    path: Path | None = None,
    *,
    controlnet: Path | None = None,
    with_controlnet: bool = True,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device = "cpu",
) -> PretrainedModel:
    """Load a base model, or a checkpoint written by a generator, from local files.

    Args:
        path: a diffusers pipeline folder, an adapter's folder (see `adapters`), or a Stable Diffusion v1 checkpoint in
            one file with the tokenizer's folder beside it; the bundled small base model when None.
        controlnet: name of a subfolder of the base model, or a separate ControlNet folder or file; otherwise the base
            model's own where there is one.
        with_controlnet: False leaves the ControlNet on disk.
        dtype: of all weights in memory.
        device: where the weights go.
    Raises:
        DataError: a folder or file is missing or does not fit; the message names it.
    """
    if path is not None and is_adapter(Path(path)):
        return _load_adapted(Path(path), with_controlnet=with_controlnet, dtype=dtype, device=device)
    files = read_base_model_files(
        BUNDLED_BASE_MODEL if path is None else Path(path), controlnet=controlnet, with_controlnet=with_controlnet
    )
    models = {name: build_model(part, dtype).to(device) for name, part in files.parts.items()}
    _use_cores_for(*models.values())
    unet, vae = models["unet"], models["vae"]
    side = unet.config.sample_size * 2 ** (len(vae.config.block_out_channels) - 1)
    second = models.get("text_encoder_2")
    tokenizer_2 = None
    if second is not None and files.tokenizer_2 is not None:
        tokenizer_2 = _load_tokenizer(files.tokenizer_2, second.config.max_position_embeddings)
    return PretrainedModel(
        tokenizer=_load_tokenizer(files.tokenizer, models["text_encoder"].config.max_position_embeddings),
        text_encoder=models["text_encoder"],
        vae=vae,
        unet=unet,
        controlnet=models.get("controlnet"),
        scheduler_config=complete_schedule(files),
        image_size=(side, side),
        tokenizer_2=tokenizer_2,
        text_encoder_2=second,
        zero_empty_prompt=files.zero_empty_prompt,
        tokenizer_3=None if files.tokenizer_3 is None else _load_t5_tokenizer(files.tokenizer_3),
        text_encoder_3=models.get("text_encoder_3"),
    )


def _load_adapted(checkpoint: Path, **settings: Any) -> PretrainedModel:
    """The base model of an adapter, changed by it."""
    adapter = read_adapter(checkpoint)
    check_base_model(checkpoint, adapter)
    base_model = load_base_model(adapter.base_model, controlnet=adapter.controlnet, **settings)
    for name in adapter.networks:
        if (network := getattr(base_model, name)) is not None:
            merge_adapter(network, name, checkpoint)
    return base_model


def load_autoencoder(path: Path, device: str | torch.device = "cpu") -> Any:
    """The autoencoder of a base model alone, as `load_base_model` has it in float32.

    Raises:
        DataError: as `load_base_model`.
    """
    vae = build_model(read_parts(path).parts["vae"], torch.float32).to(device)
    _use_cores_for(vae)
    return vae


def load_text_encoder(path: Path) -> tuple[Any, Any]:
    """Tokenizer and first text encoder of a base model or an adapter alone, as `load_base_model` has them in float32.

    Raises:
        DataError: as `load_base_model`.
    """
    if is_adapter(path):
        adapter = read_adapter(path)
        check_base_model(path, adapter)
        path = adapter.base_model
    files = read_parts(path)
    encoder = build_model(files.parts["text_encoder"], torch.float32)
    return _load_tokenizer(files.tokenizer, encoder.config.max_position_embeddings), encoder


def _use_cores_for(*models: Any) -> None:
    """Large networks are computed with many threads, also small ones beside them."""
    use_cores_for(sum(weight.nbytes for model in models for weight in model.parameters()))


def _load_tokenizer(folder: Path, max_length: int) -> Any:
    from transformers import CLIPTokenizer

    try:
        tokenizer = CLIPTokenizer.from_pretrained(str(folder), local_files_only=True)
    except Exception as error:  # the tokenizer's own parser raises bare exceptions
        raise DataError(f"{folder}: cannot be loaded as a CLIP tokenizer: {error}") from error
    # A folder of vocab.json and merges.txt alone does not say how long prompts may be.
    tokenizer.model_max_length = min(tokenizer.model_max_length, max_length)
    return tokenizer


def _load_t5_tokenizer(folder: Path) -> Any:
    from transformers import AutoTokenizer

    try:
        return AutoTokenizer.from_pretrained(str(folder), local_files_only=True)
    except Exception as error:
        raise DataError(f"{folder}: cannot be loaded as a T5 tokenizer: {error}") from error


def training_scheduler(config: dict[str, Any]) -> Any:
    """The scheduler of diffusers that says which noise a network was trained with."""
    from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
    from diffusers.schedulers.scheduling_flow_match_euler_discrete import FlowMatchEulerDiscreteScheduler

    kind: Any = FlowMatchEulerDiscreteScheduler if is_flow(config) else DDPMScheduler
    return kind.from_config(config)


def save_base_model(base_model: PretrainedModel, folder: Path, dtype: torch.dtype | None = None) -> None:
    """Write an ordinary diffusers pipeline folder, with safetensors weights.

    The code of the patch autoencoder, which is no class of diffusers, goes along: with `trust_remote_code=True` the
    folder loads without ctlev.

    Args:
        base_model: what to write.
        folder: is created.
        dtype: of the written weights, their own when None. The autoencoder always stays as it is: half precision would
            break the exactness of the patch code.
    """
    folder.mkdir(parents=True, exist_ok=True)
    scheduler = training_scheduler(base_model.scheduler_config)
    base_model.vae.save_pretrained(folder / "vae", safe_serialization=True)
    library = _library(base_model.vae)
    if library not in LIBRARIES:
        source = Path(inspect.getfile(type(base_model.vae)))
        shutil.copyfile(source, folder / "vae" / source.name)
        library = source.stem
    scheduler.save_pretrained(folder / "scheduler")
    base_model.tokenizer.save_pretrained(folder / "tokenizer")
    with_transformer = is_transformer(base_model.unet)
    kind = "StableDiffusion" if base_model.text_encoder_2 is None else "StableDiffusionXL"
    kind = "StableDiffusion3" if with_transformer else kind
    index: dict[str, Any] = {
        "_class_name": f"{kind}Pipeline" if base_model.controlnet is None else f"{kind}ControlNetPipeline",
        "scheduler": ["diffusers", type(scheduler).__name__],
        "tokenizer": ["transformers", "CLIPTokenizer"],
        "vae": [library, type(base_model.vae).__name__],
    }
    if base_model.tokenizer_2 is None:
        index |= {"safety_checker": [None, None], "feature_extractor": [None, None], "requires_safety_checker": False}
    else:
        base_model.tokenizer_2.save_pretrained(folder / "tokenizer_2")
        index |= {
            "tokenizer_2": ["transformers", "CLIPTokenizer"],
        }
    if with_transformer:
        index |= {"tokenizer_3": [None, None], "text_encoder_3": [None, None]}
    elif base_model.tokenizer_2 is not None:
        index[ZERO_EMPTY_PROMPT] = base_model.zero_empty_prompt
    if base_model.tokenizer_3 is not None:
        base_model.tokenizer_3.save_pretrained(folder / "tokenizer_3")
        index["tokenizer_3"] = ["transformers", type(base_model.tokenizer_3).__name__]
    for attribute in ("text_encoder", "text_encoder_2", "text_encoder_3", "unet", "controlnet"):
        model = getattr(base_model, attribute)
        if model is None:
            continue
        name = "transformer" if attribute == "unet" and with_transformer else attribute
        index[name] = [_library(model), type(model).__name__]
        written = copy.deepcopy(model)
        for parameter in written.parameters():
            parameter.data = parameter.data.to(dtype or parameter.dtype)
        written.save_pretrained(folder / name, safe_serialization=True)
    (folder / "model_index.json").write_text(json.dumps(index, indent=2) + "\n")
    for config_file in folder.glob("*/config.json"):
        # Where the weights were loaded from is nobody's business, and would give equal checkpoints unequal digests.
        config = read_json(config_file)
        config.pop("_name_or_path", None)
        config_file.write_text(json.dumps(config, indent=2) + "\n")


def _library(model: Any) -> str:
    """What `model_index.json` calls the home of a class: a library, or for our own class its module."""
    module = type(model).__module__
    top = module.split(".", 1)[0]
    return top if top in LIBRARIES else module


@torch.no_grad()
def control_input(base_model: PretrainedModel, images: torch.Tensor | None) -> torch.Tensor | None:
    """What the ControlNet takes of condition images [B, 3, H, W] in [0, 1]: themselves, of a transformer latents.

    Those are the means of the autoencoder's posteriors, where diffusers' pipeline draws from them: a condition has no
    noise of its own. As there, ControlNets that are told no pooled prompt get them without `shift_factor`.
    """
    if images is None or base_model.controlnet is None or not is_transformer(base_model.controlnet):
        return images
    vae, config = base_model.vae, base_model.controlnet.config
    count = max(1, ENCODE_PIXELS // (images.shape[2] * images.shape[3]))
    parts = (2 * part.to(vae.device, vae.dtype) - 1 for part in images.split(count))
    latents = torch.cat([vae.encode(part).latent_dist.mean.float() for part in parts])
    if config.get("force_zeros_for_pooled_projection"):
        return latents * base_model.scaling_factor
    return base_model.scale_latents(latents)


def encode_posterior(vae: Any, images: Any) -> tuple[torch.Tensor, torch.Tensor | None]:
    """What an autoencoder makes of images [B, H, W, 3] uint8, not scaled, on its device.

    Returns:
        Means [B, C, h, w] float32 of the latents, and their standard deviations; None for a code without noise.
    """
    tensor = images_to_tensor(images).to(vae.device, vae.dtype)
    posterior = vae.encode(tensor).latent_dist
    return posterior.mean.float(), posterior.std.float() if hasattr(posterior, "std") else None


@torch.no_grad()
def decode_latents(base_model: PretrainedModel, latents: torch.Tensor) -> torch.Tensor:
    """Images [B, 3, H, W] float32 of scaled latents [B, C, h, w], not clipped.

    Autoencoders of Stable Diffusion can overflow in half precision. Images that are not finite are decoded again in
    single precision, each by itself, so that no image depends on the others of its batch; this is logged.

    Raises:
        DataError: they are not finite in single precision either.
    """
    vae = base_model.vae
    latents, dtype = latents.float() / base_model.scaling_factor + base_model.shift_factor, vae.dtype
    images = vae.decode(latents.to(dtype)).sample.float()
    broken = [row for row, image in enumerate(images) if not bool(torch.isfinite(image).all())]
    if broken and dtype != torch.float32:
        logger.warning(
            "%d of %d images were not finite in %s; the autoencoder decodes them again in float32",
            len(broken), len(images), str(dtype).removeprefix("torch."),
        )  # fmt: skip
        vae.float()
        for row in broken:
            images[row] = vae.decode(latents[row : row + 1]).sample[0]
        vae.to(dtype)  # float32 holds every half: the weights are again what they were
    if broken and not bool(torch.isfinite(images).all()):
        where = "the latents" if not bool(torch.isfinite(latents).all()) else "the decoded images"
        raise DataError(f"{where} of {len(broken)} of {len(images)} samples hold values that are not finite")
    return images


def images_to_tensor(images: Any) -> torch.Tensor:
    """Images [N, H, W, 3] uint8 to [N, 3, H, W] float32 in [-1, 1], what autoencoders take."""
    return torch.from_numpy(images.astype("float32")).permute(0, 3, 1, 2).contiguous() / 127.5 - 1


def conditions_to_tensor(images: Any) -> torch.Tensor:
    """Condition images [N, H, W, 3] uint8 to [N, 3, H, W] float32 in [0, 1], what ControlNets take.

    Red first: a ControlNet that was trained on blue first says so in its config and exchanges them itself.
    """
    return torch.from_numpy(np.asarray(images).astype("float32")).permute(0, 3, 1, 2).contiguous() / 255
