"""Options of training that pre-training and both diffusion generators share. Imports nothing heavy."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator

from ctlev_core.diffusion.compilation import Compile
from ctlev_core.diffusion.training.checks import check_together
from ctlev_core.pictures.image_moves import Moves
from ctlev_core.pictures.labelled_pictures import PictureOptions
from data_contracts.config import RUN_SETTING, Frozen


class TrainingOptions(Frozen):
    """How long and how fast to train. The paper gives epochs and batch sizes, but no learning rate."""

    num_steps: int = Field(
        default=1200, gt=0, description="optimiser steps; the paper trains 80 (text) and 600 epochs (skeleton)"
    )
    batch_size: int = Field(default=8, gt=0, description="images in memory at a time; paper: 4 (text), 2 (skeleton)")
    gradient_accumulation: int = Field(
        default=1, gt=0, description="batches an optimiser step; paper: 32 and 64, on 4 GPUs"
    )
    learning_rate: float = Field(
        default=1e-3, gt=0, description="peak, for the small base model; 1e-5 is usual for Stable Diffusion"
    )
    warmup_steps: int = Field(default=30, ge=0, description="linear rise of the learning rate")
    final_learning_rate: float = Field(
        default=0.05, ge=0, le=1, description="share of the peak that a linear decay ends at"
    )
    weight_decay: float = Field(default=1e-3, ge=0, description="decoupled (AdamW)")
    max_gradient_norm: float = Field(default=1.0, gt=0, description="gradients are scaled down to this norm")
    ema_decay: float = Field(
        default=0.995, ge=0, lt=1, description="of the averaged weights that are kept; 0 = no averaging"
    )
    snr_gamma: float | None = Field(
        default=None,
        gt=0,
        description="min-SNR loss weights (Hang et al., ICCV 2023); null = plain; with "
        "v-prediction min-SNR hardly trains the noisy steps, which decide layout and prompt",
    )
    max_loss_weight: float = Field(
        default=5.0,
        gt=0,
        description="highest weight of the error of a network that predicts the latents, whose weight snr + 1 grows "
        "without bound at little noise; with 20 layout and prompt, decided at much noise, are learnt later",
    )
    timestep_power: float = Field(
        default=1.0,
        gt=0,
        description="time steps are drawn with density t ** (power - 1); 1 = evenly, as DDPM; 2 learns what a prompt "
        "looks like sooner",
    )
    log_every: int = Field(default=20, gt=0, description="steps between two points of the loss curve")
    validation_every: int = Field(default=400, gt=0, description="steps between two points of the validation curve")
    precision: Literal["float32", "bfloat16", "float16"] = Field(
        default="float32",
        description="of the forward pass; weights, averages and losses stay float32; float16 scales its losses and "
        "needs a CUDA device",
    )
    checkpoint_every_s: float = Field(
        default=60.0, gt=0, json_schema_extra=RUN_SETTING, description="seconds between two saves of the training state"
    )
    gradient_checkpointing: bool = Field(
        default=False,
        json_schema_extra=RUN_SETTING,
        description="compute activations again for the gradients in place of keeping them: less memory, a third slower",
    )
    compile_networks: Compile = Field(
        default="auto",
        json_schema_extra=RUN_SETTING,
        description="torch.compile; takes minutes before the first step, and a compiler: without one training goes on "
        "uncompiled and says so. auto = on a GPU, from 3,000 batches",
    )
    tensorboard: Path | None = Field(
        default=None,
        json_schema_extra=RUN_SETTING,
        description="folder for TensorBoard: curves, speed, learning rate, gradient norm and samples, each run in a "
        "subfolder of its own",
    )
    sample_every: int = Field(
        default=0,
        ge=0,
        json_schema_extra=RUN_SETTING,
        description="steps between two pictures of samples beside real frames: in TensorBoard, and as `samples/*.png` "
        "in the work folder while training lasts; 0 = none",
    )


class FineTuningOptions(TrainingOptions):
    """Fine-tuning of a base model on labelled event images."""

    base_model: Path | None = Field(
        default=None,
        json_schema_extra=RUN_SETTING,
        description="diffusers folder, or a file of Stable Diffusion v1; when null the route's bundled small one",
    )
    random_init: bool = Field(
        default=False, description="ablation: forget the base model's U-Net and ControlNet weights first"
    )
    max_loss_weight: float = Field(
        default=100.0,
        gt=0,
        description="highest weight of the error of a network that predicts the latents, whose weight snr + 1 grows "
        "without bound at little noise: there isolated events are decided; what is decided at much noise the "
        "base model knows",
    )
    lora_rank: int | None = Field(
        default=None,
        gt=0,
        description="train small additions of this rank to the weights (LoRA) in place of the weights; the checkpoint "
        "holds them alone and needs the base model; null = the weights themselves",
    )
    lora_layers: Literal["attention", "all"] = Field(
        default="attention", description="what has additions: the attention, as usual, or all layers"
    )
    prompt_dropout: float = Field(
        default=0.0, ge=0, le=1, description="share of empty prompts, needed only for guidance_scale > 1"
    )
    rot90_probability: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="share of frames shown turned by 90, 180 or 270 degrees, with their condition images, as a rolled "
        "camera would see them: bodies lie that only stood",
    )
    moves: Moves = Field(
        default=Moves(),
        description="frames are shifted, turned and scaled at random whenever they are shown, for few recordings teach "
        "their own places and sizes; of the text route only, and each batch goes through the autoencoder anew",
    )
    rehearsal_share: float = Field(
        default=0.0,
        ge=0,
        lt=1,
        description="share of each batch that is `rehearsal` pictures in place of event images, so that what the base "
        "model knows of pictures is not forgotten; of the text route only",
    )
    rehearsal: PictureOptions = Field(
        default=PictureOptions(), description="the pictures, as a rule those that the base model has learnt from"
    )
    values_at: float = Field(
        default=0.0,
        ge=0,
        lt=1,
        description="time step, as a share of the schedule, at which it is measured how real values scatter about "
        "expected ones, for sampling.values=drawn; 0 = not measured; of the text route only",
    )
    num_validation: int = Field(
        default=64, ge=0, description="frames held back for the validation loss, a tenth at most"
    )
    max_frames: int | None = Field(
        default=None,
        gt=0,
        description="ablation: learn from so many frames at most; fewer are always among those of more, and the frames "
        "held back are the same; null = all",
    )
    optimizer: Literal["adamw", "muon"] = Field(
        default="adamw",
        description="`learning_rate` is Adam's with both: muon steps weight matrices 20 times as far, and everything "
        "else by Adam",
    )
    keep: Literal["last", "best"] = Field(
        default="last",
        description="the weights that training ends with: of the last step, or of the lowest validation loss",
    )
    patience: int | None = Field(
        default=None,
        gt=0,
        description="stop after so many validations in a row that did not lower the validation loss; null = never",
    )
    device: str = Field(default="auto", json_schema_extra=RUN_SETTING, description="auto, cpu, cuda, cuda:1 ...")
    num_processes: int | None = Field(
        default=None,
        gt=0,
        json_schema_extra=RUN_SETTING,
        description="processes, each with a GPU of its own where there are any, that share the `gradient_accumulation` "
        "batches of a step evenly; null = as many as `accelerate launch` or `torchrun` started, else 1",
    )
    fsdp: bool | None = Field(
        default=None,
        json_schema_extra=RUN_SETTING,
        description="share out weights, gradients and moments over `num_processes` (fully sharded data parallelism): "
        "less memory of each GPU for more traffic between them; null = as `accelerate launch` was told",
    )

    @property
    def num_pictures(self) -> int:
        """Of a batch, pictures that are rehearsed."""
        return round(self.batch_size * self.rehearsal_share)

    @property
    def num_turns(self) -> int:
        """Quarter turns in which frames may be shown, the one as they are among them."""
        return 4 if self.rot90_probability else 1

    @model_validator(mode="after")
    def _go_together(self) -> Self:
        check_together(self)
        return self

    @model_validator(mode="after")
    def _rehearsal_needs_pictures(self) -> Self:
        if self.rehearsal_share and self.rehearsal.root is None:
            raise ValueError("rehearsal_share needs rehearsal.root, the pictures that are shown")
        if self.rehearsal_share and not 0 < self.num_pictures < self.batch_size:
            raise ValueError(
                f"rehearsal_share {self.rehearsal_share:g} of batch_size {self.batch_size} is {self.num_pictures} "
                "pictures; expected at least one, and at least one frame beside them"
            )
        return self


class MotionOptions(TrainingOptions):
    """Training of motion layers, which make the frames of a stretch from one another, in a fine-tuned generator."""

    context: int = Field(
        default=16, ge=2, le=32, description="consecutive frames that are made from one another; 16 as AnimateDiff's"
    )
    shared_noise: float = Field(
        default=0.5,
        ge=0,
        lt=1,
        description="share of the noise's variance that the frames of a stretch have in common, in training and in "
        "sampling: what does not change from frame to frame then begins alike",
    )
    num_steps: int = Field(default=600, gt=0, description="optimiser steps")
    batch_size: int = Field(default=32, gt=0, description="frames in memory at a time, as whole stretches")
    learning_rate: float = Field(default=1e-3, gt=0, description="peak")
    validation_every: int = Field(default=200, gt=0, description="steps between two points of the validation curve")
    num_validation: int = Field(
        default=16, ge=0, description="stretches held back for the validation loss, a tenth at most"
    )
    optimizer: Literal["adamw", "muon"] = Field(default="adamw", description="as of fine-tuning")
    device: str = Field(default="auto", json_schema_extra=RUN_SETTING, description="auto, cpu, cuda, cuda:1 ...")

    @property
    def stretches_at_a_time(self) -> int:
        """Whole stretches that `batch_size` frames have room for, one at least."""
        return max(1, self.batch_size // self.context)

    @model_validator(mode="after")
    def _draws_no_samples(self) -> Self:
        if self.sample_every:
            raise ValueError("sample_every draws samples of a fine-tuning; a training of motion layers has none")
        return self


class StudentOptions(TrainingOptions):
    """Distillation of a fine-tuned generator into a student that needs few evaluations of the network."""

    num_evaluations: int = Field(
        default=2, ge=1, le=8, description="evaluations of the network an image; a student is made for one number"
    )
    teacher_evaluations: int = Field(
        default=12,
        ge=2,
        le=200,
        description="evaluations of the teacher on the way from noise to the lowest noise, shared out evenly among "
        "those of the student and rounded up",
    )
    tune: Literal["unet", "both"] = Field(
        default="both", description="what learns: the U-Net alone, or the ControlNet too where there is one"
    )
    rot90_probability: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="share of condition images turned by 90, 180 or 270 degrees, as in fine-tuning",
    )
    num_steps: int = Field(default=400, gt=0, description="optimiser steps")
    batch_size: int = Field(
        default=16, gt=0, description="states that the student learns from at a time; whole trajectories"
    )
    learning_rate: float = Field(
        default=2e-4, gt=0, description="peak; higher ones lose more of what the teacher knows than is learnt anew"
    )
    weight_decay: float = Field(default=0.0, ge=0, description="decoupled (AdamW)")
    ema_decay: float = Field(
        default=0.99, ge=0, lt=1, description="of the averaged weights that are kept; 0 = no averaging"
    )
    validation_every: int = Field(default=200, gt=0, description="steps between two points of the validation curve")
    num_validation: int = Field(
        default=32, ge=0, description="conditions held back for the validation loss, a tenth at most"
    )
    optimizer: Literal["adamw", "muon"] = Field(default="muon", description="as of fine-tuning")
    device: str = Field(default="auto", json_schema_extra=RUN_SETTING, description="auto, cpu, cuda, cuda:1 ...")

    @property
    def trajectories_at_a_time(self) -> int:
        """Whole trajectories, of a state for each evaluation, that `batch_size` has room for, one at least."""
        return max(1, self.batch_size // self.num_evaluations)

    @model_validator(mode="after")
    def _only_what_a_student_heeds(self) -> Self:
        for name in ("snr_gamma", "max_loss_weight", "timestep_power", "sample_every"):
            if getattr(self, name) != TrainingOptions.model_fields[name].default:
                raise ValueError(f"{name} is of a training on noised frames; a student learns from trajectories")
        return self


class LatentOptions(Frozen):
    """How latents are encoded before a training; what the autoencoder is, the digests of its files tell."""

    base_model: Path = Field(json_schema_extra=RUN_SETTING, description="diffusers folder or single file")
    device: str = Field(default="auto", json_schema_extra=RUN_SETTING, description="as of fine-tuning")
    num_turns: int = Field(default=1, ge=1, le=4, description="quarter turns, the one as they are among them")
