"""Ingest recordings, encode them as event images and render the conditions to train on and to sample from."""

from __future__ import annotations

import sys
from functools import partial

from ctlev_core import plugins
from ctlev_core.diffusion.sampling.options import OF_STUDENTS, SamplingOptions
from ctlev_core.diffusion.training.options import MotionOptions, StudentOptions
from ctlev_core.plugins import PluginError, validate_options
from ctlev_core.scoring.sensor_pixels import check_in_image
from ctlev_core.supervised.frame_sequences import name_followed, training_interval_us
from data_contracts.config import ConditionChoice, Frozen
from data_contracts.experiment import Experiment, LabelChoice
from data_contracts.labels import HeldOut
from data_contracts.manifest import ManifestRef, read_manifest
from flows.cli import script
from flows.command_line import Command
from flows.settings import flow
from tasks.choose_labels import cover_labels, find_hard_labels
from tasks.condition import condition_frames, condition_samples
from tasks.contact_sheet import contact_sheet, publish_contact_sheet
from tasks.downstream import train_downstream
from tasks.encode import encode
from tasks.ingest import ingest
from tasks.stage import call_together
from tasks.store import home_folder
from tasks.subset import take_fold, take_recorded

NUM_FOLDS = 2
"""Of the cross-validation by which hard labels are found."""


class PreparedDataset(Frozen):
    """Manifests of a dataset ready for training and sampling; `poses` are the recordings whose labels are sampled,
    `more_frames` other recorded frames to train on, `target_frames` those of another dataset to train and test on, of
    `target_recordings`.
    """

    recordings: ManifestRef
    poses: ManifestRef
    frames: ManifestRef
    frame_conditions: ManifestRef
    sample_conditions: ManifestRef
    contact_sheet: ManifestRef
    more_frames: ManifestRef | None = None
    target_frames: ManifestRef | None = None
    target_recordings: ManifestRef | None = None

    @property
    def tested_frames(self) -> ManifestRef:
        """What downstream models are trained on as `recorded`, and tested on."""
        return self.target_frames or self.frames

    @property
    def tested_recordings(self) -> ManifestRef:
        """What these frames are of."""
        return self.target_recordings or self.recordings


@flow(name="prepare-dataset")
def prepare_dataset(experiment: Experiment) -> PreparedDataset:
    """Ingest, encode and condition one dataset."""
    recordings = ingest(dataset=experiment.dataset, label=experiment.dataset.name)
    frames = encode(
        recordings,
        encoding=experiment.encoding,
        windows=experiment.windows,
        held_out=held_out_of(experiment),
        label=experiment.encoding.name,
    )
    if experiment.num_recorded is not None:
        frames = take_recorded(
            frames, count=experiment.num_recorded, seed=experiment.seed, label="frames to learn from"
        )
    poses, target_frames, target_recordings = recordings, None, None
    if experiment.target is not None:
        poses = target_recordings = ingest(dataset=experiment.target, label=f"{experiment.target.name}, target")
        target_frames = encode(
            poses,
            encoding=experiment.encoding,
            windows=experiment.windows,
            held_out=held_out_of(experiment),
            label="target",
        )
    if experiment.poses is not None:
        poses = ingest(dataset=experiment.poses, label=f"{experiment.poses.name}, poses")
    frame_conditions = condition_training_frames(experiment, recordings, frames, experiment.condition)
    sample_conditions = condition_asked_samples(experiment, poses, recordings, frames, experiment.condition)
    if sample_conditions.digest and _in_stretches(experiment):  # planned ones cannot be looked at
        told, learnt = read_manifest(sample_conditions), read_manifest(frames)
        name_followed(told.table, training_interval_us(learnt), told.ref.path)
    sheet = contact_sheet(
        frames,
        frame_conditions,
        sample_conditions,
        title=experiment.name,
        notice=experiment.data_notice,
        label="contact sheet of conditions",
    )
    return PreparedDataset(
        recordings=recordings,
        poses=poses,
        frames=frames,
        frame_conditions=frame_conditions,
        sample_conditions=sample_conditions,
        contact_sheet=sheet,
        more_frames=_more_frames(experiment),
        target_frames=target_frames,
        target_recordings=target_recordings,
    )


def _in_stretches(experiment: Experiment) -> bool:
    """Are frames made together with those that follow one another, by the generator or a baseline?"""
    own = [experiment, *experiment.baselines.values()]
    return any(one.motion_layers is not None or one.sampling.get("noise") == "stretches" for one in own)


def held_out_of(experiment: Experiment) -> HeldOut | None:
    """What `encode` is told: None for test recordings, as it was before there was a choice."""
    return None if experiment.evaluate_on == "test" else experiment.evaluate_on


def _more_frames(experiment: Experiment) -> ManifestRef | None:
    """Other recordings to train on, where the experiment names some."""
    more = experiment.oracle
    if more is None:
        return None
    recordings = ingest(dataset=more.dataset, label=f"{more.dataset.name}, more recordings")
    windows = more.windows or experiment.windows
    return encode(recordings, encoding=experiment.encoding, windows=windows, label="more recordings")


def condition_training_frames(
    experiment: Experiment,
    recordings: ManifestRef,
    frames: ManifestRef,
    condition: ConditionChoice,
    part: str | None = None,
) -> ManifestRef:
    """The conditions a generator learns from; of one `part` of a union, or of all."""
    return condition_frames(
        recordings,
        frames,
        condition=condition,
        encoding=experiment.encoding,
        seed=experiment.seed,
        part=part,
        label=_of_part(f"{condition.name}, training", part),
    )


def condition_asked_samples(
    experiment: Experiment,
    poses: ManifestRef,
    recordings: ManifestRef,
    frames: ManifestRef,
    condition: ConditionChoice,
    part: str | None = None,
    *,
    baseline: str | None = None,
) -> ManifestRef:
    """The conditions a generator is asked for; of the same labels for every condition of a `part`, or of all.

    A `baseline` may ask for other labels than the experiment, or for such as do not follow one another in time.
    """
    in_order = experiment.in_temporal_order(baseline)
    order, length = ("in_time", stretch_length(experiment)) if in_order else ("random", None)
    labels = experiment.labels if baseline is None else experiment.labels_of(baseline)
    return condition_samples(
        poses,
        recordings,
        frames,
        choose_labels(experiment, poses, recordings, frames, labels),
        condition=condition,
        encoding=experiment.encoding,
        windows=experiment.windows,
        count=experiment.num_synthetic,
        order=order if length is None else "stretches",
        views=experiment.view,
        seed=experiment.seed,
        part=part,
        length=length,
        label=_of_part(f"{condition.name}, to sample", part),
    )


def stretch_length(experiment: Experiment) -> int | None:
    """Moments of each stretch of labels to sample from; None where they are no stretches.

    Raises:
        PluginError: as `motion_options`.
    """
    found = [motion_options(experiment, name) for name in (None, *experiment.baselines)]
    contexts = [options.context for options in found if options is not None]
    return experiment.stretch_length or max(contexts, default=None)


def motion_options(experiment: Experiment, baseline: str | None = None) -> MotionOptions | None:
    """The options of the motion layers of the experiment's own generator, or a baseline's; None where it has none.

    Raises:
        PluginError: an option is unknown or wrong, the generator has no place for such layers, or windows are too few.
    """
    asked = experiment if baseline is None else experiment.baselines[baseline]
    if asked.motion_layers is None:
        return None
    where = "motion_layers" if baseline is None else f"baselines.{baseline}.motion_layers"
    options = validate_options(MotionOptions, asked.motion_layers, where)
    if not isinstance(plugins.load_options(asked.sampling_choice).options, SamplingOptions):
        raise PluginError(f"{where}: expected a diffusion generator, got {asked.generator.name!r}")
    if getattr(plugins.load_options(asked.generator).options, "lora_rank", None) is not None:
        raise PluginError(f"{where}: expected a generator that is trained whole, got generator.options.lora_rank")
    most = experiment.windows.max_windows
    if most is not None and most < options.context:
        raise PluginError(
            f"{where}.context: stretches of {options.context} frames, but windows.max_windows keeps {most} of a "
            "recording"
        )
    return options


def student_options(experiment: Experiment, baseline: str | None = None) -> StudentOptions | None:
    """The options of the student of the experiment's own generator, or of a baseline's; None where it has none.

    Raises:
        PluginError: an option is unknown or wrong, or the generator or the way it is sampled cannot be distilled.
    """
    asked = experiment if baseline is None else experiment.baselines[baseline]
    before = "" if baseline is None else f"baselines.{baseline}."
    sampling = plugins.load_options(asked.sampling_choice).options
    is_diffusion = isinstance(sampling, SamplingOptions)
    if is_diffusion and sampling.scheduler == OF_STUDENTS:
        raise PluginError(
            f"{before}sampling.scheduler: a student gets {OF_STUDENTS!r} by itself where {before}student is set; "
            f"expected the generator's own, such as 'unipc'"
        )
    if asked.student is None:
        return None
    where = f"{before}student"
    options = validate_options(StudentOptions, asked.student, where)
    if not is_diffusion:
        raise PluginError(f"{where}: expected a diffusion generator, got {asked.generator.name!r}")
    if sampling.controlnet_every > 1:
        raise PluginError(f"{where}: expected sampling.controlnet_every 1, got {sampling.controlnet_every}")
    if options.rot90_probability and not hasattr(plugins.load_options(asked.generator).options, "controlnet"):
        raise PluginError(f"{where}.rot90_probability turns condition images, {asked.generator.name!r} takes prompts")
    return options


def choose_labels(
    experiment: Experiment, poses: ManifestRef, recordings: ManifestRef, frames: ManifestRef, labels: LabelChoice
) -> ManifestRef | None:
    """The label moments to sample from; None where `condition_samples` chooses them itself, at random.

    Nothing of it sees a frame that is held out.
    """
    count, seed, encoding = experiment.num_synthetic, experiment.seed, experiment.encoding
    if labels == "random":
        return None
    if labels == "coverage":
        return cover_labels(
            poses, recordings, frames, encoding=encoding, count=count, seed=seed, label="labels, coverage"
        )
    check_in_image(experiment.metrics[0], "labels 'hard'")
    folds = [
        take_fold(frames, fold=fold, num_folds=NUM_FOLDS, seed=seed, label=f"fold {fold}") for fold in range(NUM_FOLDS)
    ]
    calls = [
        partial(train_downstream, [fold], downstream=experiment.downstream, seed=seed, label=f"judge of fold {number}")
        for number, fold in enumerate(folds)
    ]
    return find_hard_labels(
        call_together(*calls),
        folds,
        poses,
        recordings,
        frames,
        downstream=experiment.downstream,
        metric=experiment.metrics[0],
        encoding=encoding,
        count=count,
        seed=seed,
        label="labels, hard",
    )


def _of_part(label: str, part: str | None) -> str:
    return label if part is None else f"{label}, {part} alone"


COMMAND = Command(
    prepare_dataset,
    lambda dataset, experiment: (
        f"recordings: {dataset.recordings.rows} in {dataset.recordings.path}\n"
        f"frames:     {dataset.frames.rows} in {dataset.frames.path}\n"
        + publish_contact_sheet(dataset.contact_sheet, home_folder(), experiment.name)
    ),
)


if __name__ == "__main__":
    sys.exit(script("prepare"))
