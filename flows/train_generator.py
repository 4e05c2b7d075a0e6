"""Fine-tune one generator on labelled event images."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from ctlev_core import plugins
from ctlev_core.diffusion.training.options import MotionOptions
from ctlev_core.plugin_contracts import GeneratorOfLatents
from ctlev_core.plugins import validate_options
from data_contracts.config import GeneratorChoice
from data_contracts.experiment import Experiment
from data_contracts.manifest import ManifestRef
from flows.cli import script
from flows.command_line import Command
from flows.prepare_dataset import PreparedDataset, motion_options, prepare_dataset
from flows.settings import flow
from tasks.finetune import finetune
from tasks.latents import encode_latents
from tasks.motion_layers import train_motion_layers
from tasks.pretrain import pretrain
from tasks.stage import call_flow, numbered

if TYPE_CHECKING:  # torch, which most plans do without
    from ctlev_core.diffusion.pretraining.pretraining import PretrainingOptions


@flow(name="train-generator")
def train_generator(experiment: Experiment, dataset: PreparedDataset | None = None, number: int = 0) -> ManifestRef:
    """Fine-tune the experiment's generator, the `number`-th of several; the dataset is prepared unless it is given."""
    if dataset is None:
        dataset = call_flow(prepare_dataset, experiment)
    seed, label = experiment.seed + number, numbered(experiment.generator.name, number)
    checkpoint = fine_tuned(
        experiment,
        dataset.frames,
        dataset.frame_conditions,
        generator=experiment.generator,
        seed=seed,
        label=label,
    )
    return with_motion_layers(
        checkpoint,
        dataset.frames,
        dataset.frame_conditions,
        options=motion_options(experiment),
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


COMMAND = Command(train_generator, lambda checkpoint, _: f"checkpoint: {checkpoint.path / 'checkpoint'}")


if __name__ == "__main__":
    sys.exit(script("train"))
