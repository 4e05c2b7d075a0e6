"""Load pre-trained weights: any local diffusers folder, Stable Diffusion v1.4 or the bundled small prior alike.

Nothing is downloaded. Only safetensors are read: a pickled `.bin` or `.ckpt` can run code while it loads.
"""

from __future__ import annotations

import copy
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from ctlev_core.diffusion.prior_files import BUNDLED_PRIOR, check_prior_folder, find_controlnet
from data_contracts.errors import DataError


@dataclass(frozen=True, eq=False)
class Prior:
    """The parts of a latent-diffusion pipeline, in evaluation mode.

    Attributes:
        tokenizer: text to token ids.
        text_encoder: token ids to prompt embeddings [N, L, D].
        vae: images in [-1, 1] to latents and back.
        unet: predicts from noisy latents.
        controlnet: steers the U-Net by a condition image; None where the folder has none.
        scheduler_config: the noise schedule the prior was trained with.
        image_size: (width, height) px of the images the U-Net was trained on.
    """

    tokenizer: Any
    text_encoder: Any
    vae: Any
    unet: Any
    controlnet: Any | None
    scheduler_config: dict[str, Any]
    image_size: tuple[int, int]

    @property
    def scaling_factor(self) -> float:
        """Latents are multiplied by it after encoding."""
        return float(self.vae.config.scaling_factor)

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


def load_prior(
    path: Path | None = None,
    *,
    controlnet: Path | None = None,
    with_controlnet: bool = True,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device = "cpu",
) -> Prior:
    """Load a prior, or a checkpoint written by a generator, from local files.

    Args:
        path: a diffusers pipeline folder; the bundled small prior when None.
        controlnet: name of a subfolder of the prior, or a separate ControlNet folder; otherwise the subfolder
            `controlnet` where there is one.
        with_controlnet: False leaves the ControlNet on disk.
        dtype: of all weights in memory.
        device: where the weights go.
    Raises:
        DataError: a folder or file is missing or does not fit; the message names it.
    """
    from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
    from diffusers.models.controlnets.controlnet import ControlNetModel
    from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
    from transformers import CLIPTextModel, CLIPTokenizer

    from ctlev_core.diffusion.patch_autoencoder import PatchAutoencoder

    folder = check_prior_folder(BUNDLED_PRIOR if path is None else Path(path), controlnet=controlnet)
    vae_class = _read_json(folder / "vae" / "config.json").get("_class_name", "AutoencoderKL")
    known = {"AutoencoderKL": AutoencoderKL, "PatchAutoencoder": PatchAutoencoder}
    if vae_class not in known:
        raise DataError(f"{folder / 'vae'}: autoencoder must be one of {', '.join(known)}, got {vae_class!r}")

    def load_model(model_class: Any, place: Path) -> Any:
        try:
            model = model_class.from_pretrained(
                str(place), local_files_only=True, use_safetensors=True, torch_dtype=dtype
            )
        except (OSError, ValueError, RuntimeError) as error:
            raise DataError(f"{place}: cannot be loaded as {model_class.__name__}: {error}") from error
        return model.to(device).eval().requires_grad_(False)

    control_folder = find_controlnet(folder, controlnet) if with_controlnet else None
    unet = load_model(UNet2DConditionModel, folder / "unet")
    vae = load_model(known[vae_class], folder / "vae")
    if vae.config.latent_channels != unet.config.in_channels:
        raise DataError(
            f"{folder}: the U-Net takes {unet.config.in_channels} latent channels, "
            f"the autoencoder makes {vae.config.latent_channels}"
        )
    try:
        tokenizer = CLIPTokenizer.from_pretrained(str(folder / "tokenizer"), local_files_only=True)
    except (OSError, ValueError) as error:
        raise DataError(f"{folder / 'tokenizer'}: cannot be loaded as a CLIP tokenizer: {error}") from error
    side = unet.config.sample_size * 2 ** (len(vae.config.block_out_channels) - 1)
    return Prior(
        tokenizer=tokenizer,
        text_encoder=load_model(CLIPTextModel, folder / "text_encoder"),
        vae=vae,
        unet=unet,
        controlnet=load_model(ControlNetModel, control_folder) if control_folder else None,
        scheduler_config=_read_json(folder / "scheduler" / "scheduler_config.json"),
        image_size=(side, side),
    )


def save_prior(prior: Prior, folder: Path, dtype: torch.dtype | None = None) -> None:
    """Write an ordinary diffusers pipeline folder, with safetensors weights.

    Args:
        prior: what to write.
        folder: is created.
        dtype: of the written weights, their own when None. The autoencoder always stays as it is: half precision would
            break the exactness of the patch code.
    """
    from diffusers.schedulers.scheduling_ddpm import DDPMScheduler

    folder.mkdir(parents=True, exist_ok=True)
    scheduler: Any = DDPMScheduler.from_config(prior.scheduler_config)
    prior.vae.save_pretrained(folder / "vae", safe_serialization=True)
    scheduler.save_pretrained(folder / "scheduler")
    prior.tokenizer.save_pretrained(folder / "tokenizer")
    index: dict[str, Any] = {
        "_class_name": "StableDiffusionPipeline" if prior.controlnet is None else "StableDiffusionControlNetPipeline",
        "scheduler": ["diffusers", type(scheduler).__name__],
        "tokenizer": ["transformers", "CLIPTokenizer"],
        "vae": [_library(prior.vae), type(prior.vae).__name__],
        "safety_checker": [None, None],
        "feature_extractor": [None, None],
        "requires_safety_checker": False,
    }
    for name in ("text_encoder", "unet", "controlnet"):
        model = getattr(prior, name)
        if model is None:
            continue
        index[name] = [_library(model), type(model).__name__]
        written = copy.deepcopy(model)
        for parameter in written.parameters():
            parameter.data = parameter.data.to(dtype or parameter.dtype)
        written.save_pretrained(folder / name, safe_serialization=True)
    (folder / "model_index.json").write_text(json.dumps(index, indent=2) + "\n")
    for config_file in folder.glob("*/config.json"):
        # Where the weights were loaded from is nobody's business, and would give equal checkpoints unequal digests.
        config = _read_json(config_file)
        config.pop("_name_or_path", None)
        config_file.write_text(json.dumps(config, indent=2) + "\n")


def _library(model: Any) -> str:
    """What `model_index.json` calls the home of a class: a library, or for our own class its module."""
    module = type(model).__module__
    top = module.split(".", 1)[0]
    return top if top in ("diffusers", "transformers") else module


def _read_json(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be read as JSON: {error}") from error


def encode_prompts(prior: Prior, prompts: list[str]) -> torch.Tensor:
    """Prompt embeddings [N, L, D]; L is the length every prompt is padded or cut to."""
    tokens = prior.tokenizer(
        prompts,
        padding="max_length",
        max_length=prior.tokenizer.model_max_length,
        truncation=True,
        return_tensors="pt",
    )
    with torch.no_grad():
        return prior.text_encoder(tokens.input_ids.to(prior.text_encoder.device))[0]


def images_to_tensor(images: Any) -> torch.Tensor:
    """Images [N, H, W, 3] uint8 to [N, 3, H, W] float32 in [-1, 1], what autoencoders take."""
    return torch.from_numpy(images.astype("float32")).permute(0, 3, 1, 2).contiguous() / 127.5 - 1


def conditions_to_tensor(images: Any, reversed_channels: bool = False) -> torch.Tensor:
    """Condition images [N, H, W, 3] uint8 to [N, 3, H, W] float32 in [0, 1], what ControlNets take."""
    if reversed_channels:
        images = images[..., ::-1]
    return torch.from_numpy(images.astype("float32")).permute(0, 3, 1, 2).contiguous() / 255
