"""Sample frames of a trained generator: as they come, or with the pixel values of recorded ones."""

from __future__ import annotations

from ctlev_core import plugins
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.pixel_decoder.options import PixelDecoderOptions
from ctlev_core.plugins import PluginError, validate_options
from data_contracts.config import SamplingChoice
from data_contracts.experiment import Experiment
from data_contracts.manifest import ManifestRef
from flows.train_generator import Checkpoints
from tasks.pixel_decoder import decode_pixels, train_pixel_decoder
from tasks.sample import sample

_OF_THE_SOLVER = ("scheduler", "num_inference_steps", "timestep_spacing", "noise")
"""Sampling options that only whole sampling depends on."""


def sample_generator(
    experiment: Experiment,
    generator: Checkpoints,
    frames: ManifestRef,
    learnt: ManifestRef,
    asked: ManifestRef,
    *,
    sampling: SamplingChoice,
    number: int = 0,
    seed: int | None = None,
    part: str | None = None,
    motion: bool = False,
    label: str,
) -> ManifestRef:
    """Sampled frames, drawn by a pixel decoder where the experiment asks for one.

    Args:
        experiment: what is asked for.
        generator: trained; its student is sampled where it has one, and the decoder learns from what was fine-tuned.
        frames: recorded ones.
        learnt: conditions of the training frames.
        asked: conditions to sample from.
        sampling: the generator's sampling options.
        number: of the generator, of several.
        seed: of the noise; None = that of the experiment and of the generator's number.
        part: of a union, whose training frames alone samples are compared with; None = all.
        motion: whether the checkpoint has motion layers.
        label: of the stages.
    """
    solver = plugins.load_options(sampling).options
    stretches = motion or (isinstance(solver, SamplingOptions) and solver.noise == "stretches")
    decoder = train_decoder(
        experiment, generator.tuned, frames, learnt, sampling=sampling, stretches=stretches, number=number, label=label
    )
    sampling = generator.student_sampling or sampling
    made = sample(
        generator.sampled,
        frames,
        asked,
        sampling=sampling if decoder is None else smooth(sampling),
        max_attempts=experiment.max_attempts,
        rounding=experiment.rounding if decoder is None else None,
        seed=experiment.seed + number if seed is None else seed,
        part=part,
        label=label,
    )
    if decoder is None:
        return made
    options = decoder_options(experiment, stretches)
    return decode_pixels(decoder, made, asked, encoding=experiment.encoding, options=options, label=label)


def train_decoder(
    experiment: Experiment,
    checkpoint: ManifestRef,
    frames: ManifestRef,
    learnt: ManifestRef,
    *,
    sampling: SamplingChoice,
    stretches: bool = False,
    number: int = 0,
    label: str,
) -> ManifestRef | None:
    """The pixel decoder of a generator; None where the experiment asks for none, or it is no diffusion model.

    Args:
        experiment: what is asked for.
        checkpoint: the trained generator.
        frames: recorded ones.
        learnt: conditions of the training frames.
        sampling: the generator's sampling options.
        stretches: whether frames are made together with those that follow one another.
        number: of the generator, of several.
        label: of the stage.
    """
    if experiment.pixel_decoder is None or not isinstance(plugins.load_options(sampling).options, SamplingOptions):
        return None
    return train_pixel_decoder(
        checkpoint,
        frames,
        learnt,
        sampling=without_solver(smooth(sampling)),
        encoding=experiment.encoding,
        decoder=decoder_options(experiment, stretches).of_training,
        seed=experiment.seed + number,
        label=label,
    )


def decoder_options(experiment: Experiment, stretches: bool = False) -> PixelDecoderOptions:
    """The options of the experiment's pixel decoder, checked; only in stretches it can see the frame before.

    Raises:
        PluginError: an option is unknown or wrong.
    """
    options = validate_options(PixelDecoderOptions, experiment.pixel_decoder or {}, "pixel_decoder")
    return options if stretches else options.model_copy(update={"previous_frame": False, "moving_noise": False})


def smooth(sampling: SamplingChoice) -> SamplingChoice:
    """The same, but faint values stay as the network expects them: the decoder decides where nothing is.

    Raises:
        PluginError: values are to be drawn in two ways.
    """
    values = sampling.options.get("values", "expected")
    if values != "expected":
        raise PluginError(f"pixel_decoder draws the values itself: leave out sampling.values, got {values!r}")
    return sampling.model_copy(update={"options": sampling.options | {"black_threshold": 0}})


def without_solver(sampling: SamplingChoice) -> SamplingChoice:
    """The same without the options that only whole sampling depends on."""
    options = {name: value for name, value in sampling.options.items() if name not in _OF_THE_SOLVER}
    return sampling.model_copy(update={"options": options})
