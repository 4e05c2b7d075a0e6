"""Make the next version of an experiment's synthetic data, and publish it if it is good enough; what a schedule runs.

python flows/regenerate.py [--preset NAME] [--set key=value ...] [--set gates.max_distance_ratio=null] [--dry-run]
"""

from __future__ import annotations

import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ctlev_core.report.sections.rejections import count_rejections
from ctlev_core.report.version_gates import check_asked, check_gates
from data_contracts.config import Frozen
from data_contracts.manifest import ManifestRef, read_manifest
from data_contracts.published import StoredArtefact, Version, published_folder, version_file
from data_contracts.regeneration import Regeneration
from data_contracts.training_sets import RECORDED, SYNTHETIC, LabelAgreement
from flows.cli import script
from flows.command_line import Command, load_experiment
from flows.evaluate import sensor_of
from flows.prepare_dataset import PreparedDataset, condition_asked_samples, prepare_dataset
from flows.sampling import sample_generator
from flows.settings import flow
from flows.train_generator import Checkpoints, train_generator
from tasks.downstream import train_downstream
from tasks.evaluate import score_model
from tasks.memorisation import memorisation
from tasks.publish import claimed, next_number
from tasks.realism import realism, realism_floors
from tasks.score_version import score_beside_real
from tasks.stage import call_flow, call_together
from tasks.store import home_folder

VERSION_STREAM = 50


class MadeVersion(Frozen):
    """The frames of a version, and the tables that hold its scores."""

    conditions: ManifestRef
    synthetic: ManifestRef
    scores: list[ManifestRef]


@flow(name="regenerate")
def regenerate(regeneration: Regeneration) -> Any:
    """Sample the next version of the synthetic data, score it, and make it the latest if it passes every gate."""
    version = make_next_version(regeneration)
    return version and _show(version)


def make_next_version(regeneration: Regeneration) -> Version | None:
    """The record of the version that was made, published or refused; None while planning.

    What a version shares with others, data and generator, is made before one is claimed.
    """
    dataset = call_flow(prepare_dataset, regeneration)
    generator = call_flow(train_generator, regeneration, dataset)
    folder = published_folder(home_folder(), regeneration.name)
    if not generator.sampled.digest:  # only planned
        _make(regeneration, dataset, generator, version_seed(regeneration.seed, next_number(folder)))
        return None
    with claimed(folder) as claim:
        version = claim.version
        if version is None:
            seed = version_seed(regeneration.seed, claim.number)
            made = _make(regeneration, dataset, generator, seed)
            version = _judge(regeneration, generator.sampled, made, claim.number, seed)
        return claim.finish(version)


def version_seed(seed: int, number: int) -> int:
    """The seed of a version's poses and noise, from that of the experiment."""
    return int(np.random.SeedSequence([seed, VERSION_STREAM, number]).generate_state(1)[0])


def _make(regeneration: Regeneration, dataset: PreparedDataset, generator: Checkpoints, seed: int) -> MadeVersion:
    """Sample and score one version."""
    conditions = dataset.sample_conditions
    if regeneration.new_poses:
        conditions = condition_asked_samples(
            regeneration.model_copy(update={"seed": seed}),
            dataset.poses,
            dataset.recordings,
            dataset.frames,
            regeneration.condition,
        )
    synthetic = sample_generator(
        regeneration,
        generator,
        dataset.frames,
        dataset.frame_conditions,
        conditions,
        sampling=regeneration.sampling_choice,
        seed=seed,
        motion=regeneration.motion_layers is not None,
        label=regeneration.generator.name,
    )
    calls = [partial(_score_likeness, regeneration, dataset, synthetic)]
    if regeneration.gates.max_label_error_ratio is not None:
        calls.append(partial(_score_labels, regeneration, dataset, synthetic))
    if regeneration.gates.need_realism:
        calls.append(partial(_score_realism, dataset, synthetic))
    scores = [score for found in call_together(*calls) for score in found]
    return MadeVersion(conditions=conditions, synthetic=synthetic, scores=scores)


def _score_likeness(regeneration: Regeneration, dataset: PreparedDataset, synthetic: ManifestRef) -> list[ManifestRef]:
    """How far from recorded frames, where features can be learnt, and how near to single ones."""
    frames = dataset.frames
    downstream, extractor, scores = regeneration.feature_extractor, None, []
    if downstream is not None:
        extractor = train_downstream([frames], downstream=downstream, seed=regeneration.seed, label="feature extractor")
        distances = list(regeneration.distances)
        scores.append(
            score_beside_real(
                extractor,
                dataset.tested_frames,
                synthetic,
                downstream=downstream,
                distances=distances,
                label="beside recorded",
            )
        )
    return [
        *scores,
        memorisation(frames, synthetic, extractor, downstream=downstream, subject=SYNTHETIC, label=SYNTHETIC),
    ]


def _score_labels(regeneration: Regeneration, dataset: PreparedDataset, synthetic: ManifestRef) -> list[ManifestRef]:
    """How well a model trained on recorded frames does on held-out recorded ones, and finds the labels of these."""
    frames, downstream, seed = dataset.tested_frames, regeneration.downstream, regeneration.downstream_seeds[0]
    model = train_downstream([frames], downstream=downstream, seed=seed, label=f"{downstream.name} on recorded")
    scored = [
        (frames, regeneration.evaluate_on, RECORDED, [dataset.poses], dataset.tested_recordings),
        (synthetic, "train", str(LabelAgreement(SYNTHETIC)), [], dataset.recordings),
    ]
    return [
        score_model(
            model,
            data,
            [frames],
            poses,
            downstream=downstream,
            metrics=list(regeneration.metrics),
            subject=subject,
            split=split,
            seed=seed,
            sensor=sensor_of(regeneration, recordings),
            label=f"{downstream.name}: {subject}",
        )
        for data, split, subject, poses, recordings in scored
    ]


def _score_realism(dataset: PreparedDataset, synthetic: ManifestRef) -> list[ManifestRef]:
    """Statistics of the version's frames beside those of recorded ones, and whether a network tells them apart."""
    frames = dataset.tested_frames
    floors = realism_floors(frames, label="recorded frames")
    return [realism(frames, synthetic, floors, name=SYNTHETIC, label=SYNTHETIC)]


def _judge(regeneration: Regeneration, checkpoint: ManifestRef, made: MadeVersion, number: int, seed: int) -> Version:
    """The record of a version: what it is, what it was made from, its scores, and how it kept the gates."""
    rows = [row for ref in made.scores for row in read_manifest(ref).table.to_pylist()]
    rejections = count_rejections(read_manifest(made.synthetic))
    # Those of single classes are in the artefacts.
    told = [row for row in rows if row["group"] == "all" or row["task"] in ("memorisation", "realism")]
    scores = {f"{row['subject']}, {row['group']}: {row['metric']}": row["value"] for row in told}
    scores["sampled again"], scores["rejected"] = rejections.num_again, rejections.num_rejected
    return Version(
        experiment=regeneration.name,
        number=number,
        seed=seed,
        made=time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        synthetic=_stored(made.synthetic),
        made_from=(_stored(checkpoint), _stored(made.conditions)),
        scored_in=tuple(_stored(ref) for ref in made.scores),
        scores=scores,
        gates=regeneration.gates,
        checks=tuple(
            check_gates(
                regeneration.gates,
                rows,
                task=regeneration.downstream.name,
                labels_of=str(LabelAgreement(SYNTHETIC)),
                rejected_share=rejections.num_rejected / rejections.num_rows,
            )
        ),
    )


def _stored(ref: ManifestRef) -> StoredArtefact:
    return StoredArtefact(stage=ref.path.parent.name, key=ref.key, digest=ref.digest, rows=ref.rows)


def _record(version: Version) -> Path:
    return version_file(published_folder(home_folder(), version.experiment), version.number)


def _show(version: Version) -> Any:
    """The state of the run, `Published` or `Rejected`, with the reasons in Prefect's log and as an artefact."""
    from prefect.artifacts import create_table_artifact
    from prefect.logging import get_run_logger
    from prefect.states import Completed

    table = [
        {"gate": c.gate, "score": c.score, "value": c.value, "at most": c.limit, "kept": c.passed}
        for c in version.checks
    ]
    create_table_artifact(table, key="version", description=f"{version}. Record: {_record(version)}")
    logger = get_run_logger()
    (logger.info if version.passed else logger.warning)(str(version))
    return Completed(data=version, name="Published" if version.passed else "Rejected", message=str(version))


def load_regeneration(preset: str, overrides: list[str]) -> Regeneration:
    """The experiment a preset describes, with gates.

    Raises:
        DataError: as `load_experiment`, or a gate judges what is never measured.
    """
    regeneration = load_experiment(preset, overrides, Regeneration)
    check_asked(regeneration.gates, regeneration.num_synthetic)
    return regeneration


COMMAND = Command(regenerate, lambda version, _: f"{version}\nrecord: {_record(version)}", load=load_regeneration)


if __name__ == "__main__":
    sys.exit(script("regenerate"))
