"""The whole experiment: recordings in, a scored report out.

python flows/full_experiment.py [--preset NAME] [--set key=value ...] [--dry-run]
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from functools import partial

from ctlev_core import plugins
from ctlev_core.plugin_contracts import GeneratorOfNames
from ctlev_core.realism.stretches import check_stretches
from ctlev_core.report.inputs import GeneratedFrames, Named, ReportInputs
from ctlev_core.report.page.report_files import publish_report, read_verdict
from data_contracts.experiment import Experiment
from data_contracts.manifest import ManifestRef, read_manifest
from data_contracts.study import Study
from data_contracts.training_sets import SYNTHETIC
from flows.baselines import baselines
from flows.cli import script
from flows.command_line import Command
from flows.evaluate import evaluate, train_without_synthetic
from flows.export_events import export_streams
from flows.prepare_dataset import PreparedDataset, held_out_of, prepare_dataset
from flows.settings import flow
from flows.speed_vs_error import speed_vs_error, speed_vs_error_of
from flows.studies import load_study
from flows.synthesize import synthesize
from flows.train_generator import train_generator
from tasks.ingest import ingest
from tasks.memorisation import memorisation
from tasks.nearest_seen import nearest_seen
from tasks.realism import event_realism, realism, realism_floors
from tasks.report import report
from tasks.sequence_realism import sequence_realism
from tasks.stage import call_flow, call_together
from tasks.store import home_folder
from tasks.study_report import study_report


@flow(name="full-experiment")
def full_experiment(experiment: Experiment | Study) -> ManifestRef:
    """Every stage from recordings to the report; what is in the store already is not computed again.

    The experiments of a study run side by side, and share what they have in common.
    """
    if isinstance(experiment, Study):
        return _study(experiment)
    dataset = call_flow(prepare_dataset, experiment)
    if experiment.sequence_length is not None and dataset.frames.digest:  # planned ones cannot be looked at
        check_stretches(
            read_manifest(dataset.frames),
            read_manifest(dataset.sample_conditions),
            experiment.windows.duration_us,
            experiment.sequence_length,
        )
    *own, compared, extractor, recorded_events, floors = call_together(
        *(partial(_own_frames, experiment, dataset, number) for number in range(experiment.num_generators)),
        lambda: call_flow(baselines, experiment, dataset),
        lambda: train_without_synthetic(experiment, dataset),
        lambda: _event_realism(experiment, dataset),
        lambda: realism_floors(dataset.frames, label="recorded frames"),
    )
    # What is shown are the first set of each generator and the first of several fine-tunings.
    first = {name: sets[0] for name, sets in compared.items()}
    checkpoint, synthetic = own[0]
    generated = {SYNTHETIC: synthetic} | {name: frames.synthetic for name, frames in first.items()}
    checkpoints = {SYNTHETIC: checkpoint} | {name: made.checkpoint for name, made in first.items() if made.checkpoint}
    evaluation, in_time, nearest, _, *measured = call_together(
        lambda: call_flow(evaluate, experiment, dataset, [synthetic for _, synthetic in own], compared),
        lambda: _sequence_realism(experiment, dataset, generated),
        lambda: _nearest_seen(experiment, dataset, checkpoint),
        lambda: None if experiment.export is None else call_flow(export_streams, experiment, dataset, synthetic),
        *(
            partial(realism, dataset.frames, frames, floors, name=name, label=name)
            for name, frames in generated.items()
        ),
        *(
            partial(
                memorisation,
                dataset.frames,
                frames,
                extractor,
                downstream=experiment.feature_extractor,
                subject=name,
                label=name,
            )
            for name, frames in generated.items()
        ),
    )
    looks, copied = measured[: len(generated)], measured[len(generated) :]
    made = ReportInputs(
        title=experiment.name,
        notice=experiment.data_notice,
        training_sets=tuple(str(one) for one in experiment.all_training_sets),
        recordings=dataset.recordings,
        frames=dataset.frames,
        frame_conditions=dataset.frame_conditions,
        conditions=dataset.sample_conditions,
        generated=tuple(
            GeneratedFrames(name, frames, *found)
            for (name, frames), *found in zip(generated.items(), copied, looks, strict=True)
        ),
        checkpoints=tuple(Named(name, one) for name, one in checkpoints.items()),
        models=tuple(Named(*pair) for pair in zip(evaluation.model_names, evaluation.models, strict=True)),
        scores=tuple(evaluation.scores),
        event_realism=recorded_events,
        realism_floors=floors,
        oracle=dataset.more_frames,
        target=dataset.target_frames,
        nearest=nearest,
    )
    return report(made, in_time, openings=evaluation.openings, label=experiment.name)


def _event_realism(experiment: Experiment, dataset: PreparedDataset) -> ManifestRef:
    reference = None
    if experiment.realism_reference is not None:
        reference = ingest(dataset=experiment.realism_reference, label="realism reference")
    return event_realism(dataset.recordings, reference, held_out=held_out_of(experiment), label="recorded events")


def _sequence_realism(
    experiment: Experiment, dataset: PreparedDataset, generated: Mapping[str, ManifestRef]
) -> ManifestRef | None:
    if experiment.sequence_length is None:
        return None
    return sequence_realism(
        dataset.frames,
        list(generated.values()),
        names=list(generated),
        length=experiment.sequence_length,
        step_us=experiment.windows.duration_us,
        label=f"training frames and {', '.join(generated)}",
    )


def _nearest_seen(experiment: Experiment, dataset: PreparedDataset, checkpoint: ManifestRef) -> ManifestRef | None:
    generator = plugins.load("generators", experiment.generator.name)
    if experiment.target is None or not isinstance(generator, GeneratorOfNames):
        return None
    return nearest_seen(
        checkpoint,
        dataset.frames,
        dataset.sample_conditions,
        generator=experiment.generator,
        label="nearest seen classes",
    )


def _study(study: Study) -> ManifestRef:
    parts, measured = study.experiments, speed_vs_error_of(study)
    calls: list[Callable[[], ManifestRef]] = [
        lambda part=part: call_flow(full_experiment, part) for part in parts.values()
    ]
    if measured is not None:
        calls.append(lambda: call_flow(speed_vs_error, measured))
    return study_report(
        call_together(*calls),
        title=study.name,
        notice=study.data_notice,
        names=list(parts),
        training_sets=[[str(one) for one in part.all_training_sets] for part in parts.values()],
        generator_names=[part.generator_names for part in parts.values()],
        pooled=list(study.pooled.items()),
        own_tests=study.pooled_tests == "own",
        num_generators=[part.num_generators for part in parts.values()],
        label=study.name,
    )


def _own_frames(experiment: Experiment, dataset: PreparedDataset, number: int) -> tuple[ManifestRef, ManifestRef]:
    generator = call_flow(train_generator, experiment, dataset, number)
    return generator.sampled, call_flow(synthesize, experiment, dataset, generator, number)


def _describe(made: ManifestRef, name: str) -> str:
    return "\n".join(filter(None, [read_verdict(made.path), publish_report(made, home_folder(), name)]))


COMMAND = Command(full_experiment, lambda made, asked: _describe(made, asked.name), load=load_study)


if __name__ == "__main__":
    sys.exit(script("run"))
