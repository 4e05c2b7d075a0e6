"""Fine-tune one generator on labelled event images."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, TypeVar

from ctlev_core import plugins
from ctlev_core.diffusion.sampling.options import OF_STUDENTS
from ctlev_core.diffusion.training.options import MotionOptions, StudentOptions
from ctlev_core.plugin_contracts import GeneratorOfLatents
from ctlev_core.plugins import validate_options
from data_contracts.config import Frozen, GeneratorChoice, SamplingChoice
from data_contracts.experiment import Experiment
from data_contracts.manifest import ManifestRef
from flows.cli import script
from flows.command_line import Command
from flows.prepare_dataset import PreparedDataset, motion_options, prepare_dataset, student_options
from flows.settings import flow
from tasks.distill import distill
from tasks.finetune import finetune
from tasks.latents import encode_latents
from tasks.motion_layers import train_motion_layers
from tasks.pretrain import pretrain
from tasks.stage import call_flow, numbered

if TYPE_CHECKING:  # torch, which most plans do without
    from ctlev_core.diffusion.pretraining.pretraining import PretrainingOptions


X = TypeVar("X", bound=Experiment)
_OF_GUIDANCE = ("guidance_scale", "guidance_interval", "autoguidance_scale", "autoguidance_layers")
"""Sampling options of a teacher that its student learns."""
_OF_THE_TEACHER = ("scheduler", "num_inference_steps", "timestep_spacing", "controlnet_every", *_OF_GUIDANCE)
"""Sampling options that a student has no use for."""


class Checkpoints(Frozen):
    """A fine-tuned generator, with its motion layers where it has them.

    Attributes:
        tuned: its checkpoint; pixel decoders learn from it.
        student: the distilled one; None = there is none.
        student_sampling: how that is sampled.
    """

    tuned: ManifestRef
    student: ManifestRef | None = None
    student_sampling: SamplingChoice | None = None

    @property
    def sampled(self) -> ManifestRef:
        """What frames are sampled from."""
        return self.student or self.tuned


@flow(name="train-generator")
def train_generator(experiment: Experiment, dataset: PreparedDataset | None = None, number: int = 0) -> Checkpoints:
    """Fine-tune the experiment's generator, the `number`-th of several; the dataset is prepared unless it is given."""
    if dataset is None:
        dataset = call_flow(prepare_dataset, experiment)
    seed, label = experiment.seed + number, numbered(experiment.generator.name, number)
    student = student_options(experiment)  # raises before anything is trained
    checkpoint = fine_tuned(
        experiment,
        dataset.frames,
        dataset.frame_conditions,
        generator=experiment.generator,
        seed=seed,
        label=label,
    )
    checkpoint = with_motion_layers(
        checkpoint,
        dataset.frames,
        dataset.frame_conditions,
        options=motion_options(experiment),
        seed=seed,
        label=label,
    )
    return with_student(
        checkpoint,
        dataset.frame_conditions,
        sampling=experiment.sampling_choice,
        options=student,
        seed=seed,
        label=label,
    )


def fine_tuned(
    experiment: Experiment,
    frames: ManifestRef,
    conditions: ManifestRef,
    *,
    generator: GeneratorChoice,
    seed: int,
    label: str,
    of_all: bool = True,
) -> ManifestRef:
    """The checkpoint of a generator; its frames are encoded first, once for several, where that is dear.

    Args:
        experiment: what is asked for.
        frames: recorded ones.
        conditions: of the training frames among them.
        generator: what learns.
        seed: of it.
        label: of the stage.
        of_all: the conditions are those of every training frame. Of some, other batches would be encoded together than
            in the stage, and the last bits of latents may hang on that.
    """
    base_model = base_model_of(experiment, generator)
    asked: dict[str, Any] = {"generator": generator, "seed": seed}
    plugin, latents = plugins.load_options(generator), None
    if of_all and base_model is None and isinstance(plugin.module, GeneratorOfLatents):
        options = plugin.module.latent_options(plugin.options)
        # A checkpoint that is there does not need them.
        if options is not None and not finetune.is_made(frames, conditions, **asked):
            latents = encode_latents(frames, latents=options, label=f"{generator.name}, autoencoder")
    return finetune(frames, conditions, base_model, latents, label=label, **asked)


def with_motion_layers(
    checkpoint: ManifestRef,
    frames: ManifestRef,
    conditions: ManifestRef,
    *,
    options: MotionOptions | None,
    seed: int,
    label: str,
) -> ManifestRef:
    """A fine-tuned generator with motion layers, where options of such layers are given."""
    if options is None:
        return checkpoint
    return train_motion_layers(checkpoint, frames, conditions, options=options, seed=seed, label=label)


def without_student(experiment: X) -> X:
    """The same experiment for what measures the fine-tuned generator: its student need not be made."""
    return experiment.model_copy(update={"student": None})


def with_student(
    checkpoint: ManifestRef,
    conditions: ManifestRef,
    *,
    sampling: SamplingChoice,
    options: StudentOptions | None,
    seed: int,
    label: str,
) -> Checkpoints:
    """A fine-tuned generator and its student, where options of one are given.

    Args:
        checkpoint: of the generator.
        conditions: of the training frames.
        sampling: how the generator is sampled; its guidance is distilled.
        options: of the student; None = none.
        seed: of it.
        label: of the stage.
    """
    if options is None:
        return Checkpoints(tuned=checkpoint)
    guidance = {name: value for name, value in sampling.options.items() if name in _OF_GUIDANCE}
    student = distill(
        checkpoint,
        conditions,
        sampling=sampling.model_copy(update={"options": guidance}),
        options=options,
        seed=seed,
        label=label,
    )
    kept = {name: value for name, value in sampling.options.items() if name not in _OF_THE_TEACHER}
    own = {"scheduler": OF_STUDENTS, "num_inference_steps": options.num_evaluations}
    return Checkpoints(
        tuned=checkpoint, student=student, student_sampling=sampling.model_copy(update={"options": kept | own})
    )


def base_model_of(experiment: Experiment, generator: GeneratorChoice) -> ManifestRef | None:
    """The experiment's own base model, for a generator that starts from one and names none; made if it must be."""
    options = plugins.load_options(generator).options
    if experiment.base_model is None or getattr(options, "base_model", ...) is not None:
        return None
    return pretrain(options=base_model_options(experiment), label="base model of pictures")


def base_model_options(experiment: Experiment) -> PretrainingOptions:
    """The options of the experiment's base model, checked; its pictures are looked through.

    Raises:
        PluginError: an option is unknown or wrong.
        DataError: there are no pictures.
    """
    from ctlev_core.diffusion.pretraining.pretraining import PretrainingOptions
    from ctlev_core.pictures.labelled_pictures import open_pictures

    options = validate_options(PretrainingOptions, experiment.base_model or {}, "base_model")
    if options.pictures.root is not None:
        open_pictures(options.pictures)
    return options


COMMAND = Command(train_generator, lambda made, _: f"checkpoint: {made.sampled.path / 'checkpoint'}")


if __name__ == "__main__":
    sys.exit(script("train"))
