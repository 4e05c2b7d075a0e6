"""The training loop of diffusers' examples, written anew from what they document: the peer of our own loop.

Source: diffusers, `examples/controlnet/train_controlnet.py` and `examples/text_to_image/train_text_to_image.py`. As
there: images are normalised and prompts tokenised by a `DataLoader` without workers; autoencoder and text encoder run
in every step, in the low precision where there is one, and so does the frozen U-Net; AdamW as torch makes it by
default; Accelerate for mixed precision, accumulation and clipping; a constant learning rate; a ControlNet's gradients
are set to zero and not dropped; averaged weights in the text example alone, where they are asked for.

Left out, in the examples' favour: decoding and resizing of image files, progress bar, trackers and checkpoints.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from ctlev_core.diffusion.pretrained.loading import PretrainedModel
from data_contracts.labels import Conditions

Precision = Literal["float32", "bfloat16"]
STAGES = ("data", "autoencoder", "text encoder", "forward", "backward", "clip and AdamW", "averages")
MAX_GRADIENT_NORM = 1.0
ADAM = {"betas": (0.9, 0.999), "weight_decay": 1e-2, "eps": 1e-8}
EMA_DECAY = 0.9999


class ImageRows(torch.utils.data.Dataset):
    """Rows of frames and conditions, made into tensors when they are asked for, a batch at a time."""

    def __init__(self, frames: np.ndarray, conditions: Conditions, tokenizer: Any) -> None:
        self._frames, self._conditions, self._tokenizer = frames, conditions, tokenizer

    def __len__(self) -> int:
        return len(self._frames)

    def __getitems__(self, rows: list[int]) -> list[dict[str, Tensor]]:
        tokens = self._tokenizer(
            [self._conditions.prompts[row] for row in rows],
            max_length=self._tokenizer.model_max_length,
            padding="max_length",
            truncation=True,
            return_tensors="pt",
        ).input_ids
        items = []
        for position, row in enumerate(rows):
            item = {"pixel_values": to_unit(self._frames[row]).sub(0.5).div(0.5), "input_ids": tokens[position]}
            if self._conditions.images is not None:
                item["conditioning_pixel_values"] = to_unit(self._conditions.images[row])
            items.append(item)
        return items


def to_unit(image: np.ndarray) -> Tensor:
    """[3, H, W] in [0, 1] of [H, W, 3] uint8."""
    return torch.from_numpy(image).permute(2, 0, 1).contiguous().float().div(255)


def collate(items: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Rows to a batch."""
    return {name: torch.stack([item[name] for item in items]) for name in items[0]}


class ExampleLoop:
    """The examples' loop over one base model, to be run some steps at a time.

    A base model with a ControlNet is trained as by `train_controlnet`, one without as by `train_text_to_image`.

    Attributes:
        seconds: of each of `STAGES`, summed up while `clock` is set.
        clock: what tells the time, None = stages are not timed.
    """

    def __init__(
        self,
        base_model: PretrainedModel,
        frames: np.ndarray,
        conditions: Conditions,
        *,
        batch_size: int,
        learning_rate: float = 1e-5,
        precision: Precision = "float32",
        use_ema: bool = False,
        seed: int = 0,
    ) -> None:
        """Take over `base_model`: its frozen parts are cast, the trained one learns. One loop at a
        time in a process.
        """
        from accelerate import Accelerator
        from accelerate.state import AcceleratorState
        from diffusers.optimization import get_scheduler
        from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
        from diffusers.training_utils import EMAModel

        torch.manual_seed(seed)
        AcceleratorState._reset_state(reset_partial_state=True)  # the precision of a process is set only once
        self._accelerator: Any = Accelerator(
            mixed_precision={"float32": "no", "bfloat16": "bf16"}[precision], cpu=base_model.unet.device.type == "cpu"
        )
        self._base_model, self._dtype = base_model, getattr(torch, precision)
        self._noise_scheduler: Any = DDPMScheduler.from_config(base_model.scheduler_config)
        self._steers = base_model.controlnet is not None
        trained = base_model.controlnet if self._steers else base_model.unet
        for part in (base_model.vae, base_model.text_encoder, base_model.unet):
            part.requires_grad_(False)
            if part is not trained and part.dtype != self._dtype:
                part.to(self._dtype)
        trained.train().requires_grad_(True)
        optimizer = torch.optim.AdamW(trained.parameters(), lr=learning_rate, **ADAM)
        rows = ImageRows(frames, conditions, base_model.tokenizer)
        self._ema = EMAModel(trained.parameters(), decay=EMA_DECAY) if use_ema else None
        self._trained, self._optimizer, self._loader, self._schedule = self._accelerator.prepare(
            trained,
            optimizer,
            torch.utils.data.DataLoader(rows, batch_size, shuffle=True, collate_fn=collate),
            get_scheduler("constant", optimizer=optimizer),
        )
        self._batches = self._endless()
        self.clock: Callable[[], float] | None = None
        self.seconds = dict.fromkeys(STAGES, 0.0)

    def run(self, num_steps: int) -> list[float]:
        """Go on for `num_steps`; their losses."""
        return [self._step() for _ in range(num_steps)]

    def _endless(self) -> Iterator[dict[str, Tensor]]:
        while True:
            yield from self._loader

    @contextlib.contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        start = self.clock() if self.clock else 0.0
        yield
        if self.clock:
            self.seconds[name] += self.clock() - start

    def _step(self) -> float:
        accelerator, base_model = self._accelerator, self._base_model
        with self._stage("data"):
            batch = next(self._batches)
        with accelerator.accumulate(self._trained):
            with self._stage("autoencoder"):
                latents = base_model.vae.encode(batch["pixel_values"].to(dtype=self._dtype)).latent_dist.sample()
                latents = latents * base_model.vae.config.scaling_factor
            with self._stage("text encoder"):
                embeddings = base_model.text_encoder(batch["input_ids"])[0]
            with self._stage("forward"):
                loss = self._loss(latents, embeddings, batch.get("conditioning_pixel_values"))
                if not self._steers:
                    # The text example gathers the loss of all processes, too.
                    accelerator.gather(loss.repeat(len(latents))).mean().item()
            with self._stage("backward"):
                accelerator.backward(loss)
            with self._stage("clip and AdamW"):
                accelerator.clip_grad_norm_(self._trained.parameters(), MAX_GRADIENT_NORM)
                self._optimizer.step()
                self._schedule.step()
                self._optimizer.zero_grad(set_to_none=not self._steers)
        if self._ema is not None:
            with self._stage("averages"):
                self._ema.step(self._trained.parameters())
        return loss.detach().item()

    def _loss(self, latents: Tensor, embeddings: Tensor, conditions: Tensor | None) -> Tensor:
        scheduler = self._noise_scheduler
        noise = torch.randn_like(latents)
        timesteps = torch.randint(0, scheduler.config.num_train_timesteps, (len(latents),), device=latents.device)
        timesteps = timesteps.long()
        noisy = scheduler.add_noise(latents, noise, timesteps)
        if conditions is None:
            predicted = self._trained(noisy, timesteps, embeddings).sample
        else:
            predicted = self._predict_steered(noisy, timesteps, embeddings, conditions)
        kind = scheduler.config.prediction_type
        if kind == "v_prediction":
            target = scheduler.get_velocity(latents, noise, timesteps)
        else:
            # The examples know no networks that predict the latents; ours may.
            target = noise if kind == "epsilon" else latents
        return torch.nn.functional.mse_loss(predicted.float(), target.float(), reduction="mean")

    def _predict_steered(self, noisy: Tensor, timesteps: Tensor, embeddings: Tensor, conditions: Tensor) -> Tensor:
        down, middle = self._trained(
            noisy,
            timesteps,
            encoder_hidden_states=embeddings,
            controlnet_cond=conditions.to(dtype=self._dtype),
            return_dict=False,
        )
        return self._base_model.unet(
            noisy,
            timesteps,
            encoder_hidden_states=embeddings,
            down_block_additional_residuals=[residual.to(dtype=self._dtype) for residual in down],
            mid_block_additional_residual=middle.to(dtype=self._dtype),
        ).sample
