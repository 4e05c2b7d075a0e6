"""Write the synthetic frames as event streams, for users of events rather than images."""

from __future__ import annotations

import sys

from data_contracts.event_export import EventExport
from data_contracts.experiment import Experiment
from data_contracts.manifest import ManifestRef
from flows.cli import script
from flows.command_line import Command
from flows.inputs import check_whole_counts
from flows.prepare_dataset import PreparedDataset, prepare_dataset
from flows.settings import flow
from flows.synthesize import synthesize
from tasks.export_events import events_folder, export_events, publish_events
from tasks.stage import call_flow
from tasks.store import home_folder


@flow(name="export-events")
def export_streams(
    experiment: Experiment, dataset: PreparedDataset | None = None, synthetic: ManifestRef | None = None
) -> ManifestRef:
    """Write the experiment's synthetic frames as event streams; what is not given is made first."""
    check_whole_counts(experiment, "export of events")
    if dataset is None:
        dataset = call_flow(prepare_dataset, experiment)
    if synthetic is None:
        synthetic = call_flow(synthesize, experiment, dataset)
    return export_events(
        synthetic,
        dataset.frames,
        dataset.recordings,
        encoding=experiment.encoding,
        export=experiment.export or EventExport(),
        label="event streams",
    )


def _foretell(experiment: Experiment) -> str:
    export = experiment.export or EventExport()
    files = "one file" if export.one_file else "a file each"
    return (
        f"would write to {events_folder(home_folder(), experiment.name)}: at most {experiment.num_synthetic} event "
        f"streams, {files}, as {export.format}, and their table"
    )


COMMAND = Command(
    export_streams,
    lambda made, experiment: publish_events(made, home_folder(), experiment.name),
    foretell=_foretell,
)


if __name__ == "__main__":
    sys.exit(script("export-events"))
