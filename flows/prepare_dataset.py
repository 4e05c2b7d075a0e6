"""Ingest recordings, encode them as event images and render the conditions to train on and to sample from."""

from __future__ import annotations

import sys

from data_contracts.config import Frozen
from data_contracts.experiment import Experiment
from data_contracts.manifest import ManifestRef
from flows.command_line import main
from flows.settings import HOME, flow
from tasks.condition import condition_frames, condition_samples
from tasks.contact_sheet import contact_sheet, publish_contact_sheet
from tasks.encode import encode
from tasks.ingest import ingest


class PreparedDataset(Frozen):
    """Manifests of a dataset ready for training and sampling."""

    recordings: ManifestRef
    frames: ManifestRef
    frame_conditions: ManifestRef
    sample_conditions: ManifestRef
    contact_sheet: ManifestRef


@flow(name="prepare-dataset")
def prepare_dataset(experiment: Experiment) -> PreparedDataset:
    """Ingest, encode and condition one dataset."""
    recordings = ingest(dataset=experiment.dataset, label=experiment.dataset.name)
    frames = encode(
        recordings, encoding=experiment.encoding, windows=experiment.windows, label=experiment.encoding.name
    )
    frame_conditions = condition_frames(
        recordings,
        frames,
        condition=experiment.condition,
        seed=experiment.seed,
        label=f"{experiment.condition.name}, training",
    )
    poses = recordings
    if experiment.poses is not None:
        poses = ingest(dataset=experiment.poses, label=f"{experiment.poses.name}, poses")
    sample_conditions = condition_samples(
        poses,
        recordings,
        frames,
        condition=experiment.condition,
        encoding=experiment.encoding,
        count=experiment.num_synthetic,
        order=experiment.pose_order,
        views=experiment.pose_views,
        seed=experiment.seed,
        label=f"{experiment.condition.name}, to sample",
    )
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
        frames=frames,
        frame_conditions=frame_conditions,
        sample_conditions=sample_conditions,
        contact_sheet=sheet,
    )


if __name__ == "__main__":
    sys.exit(
        main(
            prepare_dataset,
            lambda dataset, experiment: (
                f"recordings: {dataset.recordings.rows} in {dataset.recordings.path}\n"
                f"frames:     {dataset.frames.rows} in {dataset.frames.path}\n"
                + publish_contact_sheet(dataset.contact_sheet, HOME, experiment.name)
            ),
        )
    )
