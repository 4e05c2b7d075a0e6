"""Sample labelled synthetic event images from a fine-tuned generator, and write them as a plain folder where asked to.

python flows/synthesize.py --preset folder --set dataset.options.root=PATH --set export_folder=mine
"""

from __future__ import annotations

import sys
from pathlib import Path

from ctlev_core.report.sections.rejections import count_rejections
from data_contracts.experiment import Experiment
from data_contracts.image_folder import LABELS_FILE, METADATA_FILE, PROVENANCE_FILE, README_FILE
from data_contracts.manifest import ManifestRef, read_manifest
from data_contracts.synthesis import Synthesis
from flows.cli import script
from flows.command_line import Command, load_experiment
from flows.prepare_dataset import PreparedDataset, prepare_dataset
from flows.sampling import sample_generator
from flows.settings import flow
from flows.train_generator import Checkpoints, train_generator
from tasks.export_events import export_events
from tasks.export_images import check_export_folder, export_images
from tasks.stage import call_flow, numbered


@flow(name="synthesize")
def synthesize(
    experiment: Experiment,
    dataset: PreparedDataset | None = None,
    generator: Checkpoints | None = None,
    number: int = 0,
) -> ManifestRef:
    """Sample labelled synthetic event images, and write them as a plain folder where `export_folder` asks for one.

    The frames are those of the `number`-th generator; dataset and generator are made unless they are given.
    """
    if dataset is None:
        dataset = call_flow(prepare_dataset, experiment)
    if generator is None:
        generator = call_flow(train_generator, experiment, dataset, number)
    synthetic = sample_generator(
        experiment,
        generator,
        dataset.frames,
        dataset.frame_conditions,
        dataset.sample_conditions,
        sampling=experiment.sampling_choice,
        number=number,
        motion=experiment.motion_layers is not None,
        label=numbered(experiment.generator.name, number),
    )
    if isinstance(experiment, Synthesis) and experiment.export_folder is not None:
        _export(experiment, experiment.export_folder, dataset, synthetic)
    return synthetic


def _export(synthesis: Synthesis, folder: Path, dataset: PreparedDataset, synthetic: ManifestRef) -> None:
    """Write the folder; while planning, only say whether it could be written."""
    artefacts = {"synthetic": synthetic, "conditions": dataset.sample_conditions}
    if synthesis.export is not None:
        artefacts["event streams"] = export_events(
            synthetic,
            dataset.frames,
            dataset.recordings,
            encoding=synthesis.encoding,
            export=synthesis.export,
            label="event streams",
        )
    if not synthetic.digest:  # only planned
        check_export_folder(artefacts, folder)
        return
    export_images(artefacts, folder, name=synthesis.name, notice=synthesis.data_notice)


def load_synthesis(preset: str, overrides: list[str]) -> Synthesis:
    """The experiment a preset describes, and where its frames are exported to."""
    return load_experiment(preset, overrides, Synthesis)


def _describe(made: ManifestRef, synthesis: Synthesis) -> str:
    lines = [f"synthetic: {count_rejections(read_manifest(made))}", f"frames: {made.path}"]
    if synthesis.export_folder is not None:
        lines.append(f"exported: {synthesis.export_folder}, see its README.md")
    return "\n".join(lines)


def _foretell(synthesis: Synthesis) -> str:
    if synthesis.export_folder is None:
        return ""
    streams = " and event streams" if synthesis.export else ""
    return (
        f"would write to {synthesis.export_folder}: at most {synthesis.num_synthetic} images{streams}, without those "
        f"that the quality filter rejects, {LABELS_FILE}, {METADATA_FILE}, {PROVENANCE_FILE} and {README_FILE}"
    )


COMMAND = Command(synthesize, _describe, load=load_synthesis, foretell=_foretell)


if __name__ == "__main__":
    sys.exit(script("synthesize"))
