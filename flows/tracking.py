"""A finished run in an experiment tracker: `--track tensorboard`, `mlflow` or `wandb`.

Each experiment of a report becomes a run of the tracker, with its options, the mean of each score over trainings, some
of its synthetic frames, and its report. Nothing leaves the machine unless the tracker was told where to
(MLFLOW_TRACKING_URI, WANDB_API_KEY); by default all is kept below the home.
"""

from __future__ import annotations

import importlib.util
import os
import re
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from ctlev_core.plugins import PluginError
from ctlev_core.provenance.records import read_provenance
from ctlev_core.report.page.report_files import MARKDOWN, PAGE, PROVENANCE, read_verdict
from data_contracts.arrays import load_array
from data_contracts.compressed_arrays import SUFFIX
from data_contracts.experiment import Experiment
from data_contracts.study import Study

PROJECT = "ctlev"
NUM_IMAGES = 12
_PACKAGES = {"tensorboard": "tensorboardX", "mlflow": "mlflow", "wandb": "wandb"}
KINDS = tuple(_PACKAGES)


@dataclass(frozen=True, eq=False)
class TrackedRun:
    """What a tracker is told of one experiment.

    Attributes:
        name: such as `demo / pose`.
        options: by dotted name.
        scores: means over trainings, by score and training set: `accuracy/recorded`.
        verdict: whether synthetic data helped, in a sentence.
        frames: [N, H, W, 3] uint8, some that were made; N may be 0.
        files: the report and its tables.
    """

    name: str
    options: Mapping[str, Any]
    scores: Mapping[str, float]
    verdict: str
    frames: np.ndarray
    files: tuple[Path, ...]


def check_tracker(kind: str) -> None:
    """Look for a tracker before anything long starts.

    Raises:
        PluginError: there is no such tracker, or its package is missing.
    """
    if kind not in _PACKAGES:
        raise PluginError(f"--track: expected {', '.join(KINDS)}, got {kind!r}")
    package = _PACKAGES[kind]
    if importlib.util.find_spec(package) is None:
        raise PluginError(f"--track {kind} needs the package {package!r}: pip install -e '.[{kind}]'")


def track(kind: str, report: Path, asked: Experiment | Study, home: Path) -> str:
    """Tell a tracker of a finished report, and say where that is.

    Args:
        kind: one of `KINDS`.
        report: folder of the artefact of `report` or `study_report`.
        asked: what was run.
        home: of the store.

    Raises:
        PluginError: the tracker cannot be told now.
    """
    parts = asked.experiments if isinstance(asked, Study) else {"": asked}
    runs = [
        tracked_run(report / name, part, home, " / ".join(filter(None, (asked.name, name))))
        for name, part in parts.items()
    ]
    try:
        return _TRACKERS[kind](runs, asked.name, home)
    except Exception as error:  # each package has errors of its own
        raise PluginError(
            f"--track {kind}: {type(error).__name__}: {error}; the report is finished, the same command tells it again"
        ) from error


def tracked_run(folder: Path, experiment: Experiment, home: Path, name: str) -> TrackedRun:
    """What the folder of an experiment's report says."""
    values: dict[str, list[float]] = defaultdict(list)
    for row in pq.read_table(folder / "scores.parquet").to_pylist():
        if row["group"] == "all" and np.isfinite(row["value"]):
            values[_plain(f"{row['metric']}/{row['subject']}")].append(row["value"])
    names = (PAGE, MARKDOWN, PROVENANCE)
    return TrackedRun(
        name=name,
        options=dict(_leaves(experiment.model_dump(mode="json"), "")),
        scores={score: float(np.mean(found)) for score, found in values.items()},
        verdict=read_verdict(folder),
        frames=_frames(folder, home),
        files=tuple(folder / file for file in names if (folder / file).is_file()),
    )


def _frames(folder: Path, home: Path) -> np.ndarray:
    """Some of the experiment's own synthetic frames, where the store still has them."""
    made = next(record for record in read_provenance(folder / PROVENANCE) if record.role == "frames of synthetic")
    path = home / "artefacts" / made.stage / made.key / f"frames{SUFFIX}"
    if not path.is_file():
        return np.zeros((0, 1, 1, 3), np.uint8)
    frames = load_array(path)
    return np.asarray(frames[np.linspace(0, len(frames) - 1, min(NUM_IMAGES, len(frames))).round().astype(int)])


def _leaves(value: Any, name: str) -> list[tuple[str, Any]]:
    """Options by dotted name."""
    if isinstance(value, dict) and value:
        return [leaf for key, item in value.items() for leaf in _leaves(item, f"{name}.{key}" if name else str(key))]
    return [(name, value)]


def _plain(name: str) -> str:
    """Letters that every tracker takes in a name."""
    return re.sub(r"[^\w./-]+", "_", name.replace("+", "_and_"))


def _tensorboard(runs: list[TrackedRun], name: str, home: Path) -> str:
    from tensorboardX import SummaryWriter

    folder = home / "tensorboard"
    for run in runs:
        place = folder / run.name.replace(" / ", "_")
        with SummaryWriter(str(place), filename_suffix=".report") as writer:
            writer.add_text("options", "\n\n".join(f"{key}: {value}" for key, value in run.options.items()))
            writer.add_text("verdict", f"{run.verdict}\n\n{run.files[0] if run.files else ''}")
            for score, value in run.scores.items():
                writer.add_scalar(score, value, 0)
            if len(run.frames):
                writer.add_images("synthetic frames", run.frames, 0, dataformats="NHWC")
    return f"tracked: tensorboard --logdir {folder}"


def _mlflow(runs: list[TrackedRun], name: str, home: Path) -> str:
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    import mlflow  # pyright: ignore[reportMissingImports]

    place = os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{home / 'mlflow.db'}"
    mlflow.set_tracking_uri(place)
    if mlflow.get_experiment_by_name(name) is None and not os.environ.get("MLFLOW_TRACKING_URI"):
        mlflow.create_experiment(name, artifact_location=(home / "mlflow").as_uri())
    mlflow.set_experiment(name)
    for run in runs:
        with mlflow.start_run(run_name=run.name):
            mlflow.log_params({_plain(key): str(value)[:6000] for key, value in run.options.items()})
            mlflow.log_metrics(dict(run.scores))
            mlflow.set_tag("verdict", run.verdict[:5000])
            for file in run.files:
                mlflow.log_artifact(str(file))
            for number, frame in enumerate(run.frames):
                mlflow.log_image(frame, f"synthetic_frames/{number:02d}.png")
    return f"tracked: mlflow experiment {name!r} at {place}"


def _wandb(runs: list[TrackedRun], name: str, home: Path) -> str:
    import wandb  # pyright: ignore[reportMissingImports]

    known = any(os.environ.get(variable) for variable in ("WANDB_MODE", "WANDB_API_KEY", "WANDB_BASE_URL"))
    for run in runs:
        with wandb.init(
            project=PROJECT, name=run.name, group=name, dir=str(home), mode=None if known else "offline",
            config=dict(run.options), reinit="finish_previous", notes=run.verdict,
        ) as told:  # fmt: skip
            told.log({**run.scores, "synthetic frames": [wandb.Image(frame) for frame in run.frames]})
            report = wandb.Artifact("report", type="report")
            for file in run.files:
                report.add_file(str(file))
            told.log_artifact(report)
    return f"tracked: wandb project {PROJECT!r}" + ("" if known else f", offline, in {home / 'wandb'}")


_TRACKERS: dict[str, Callable[[list[TrackedRun], str, Path], str]] = {
    "tensorboard": _tensorboard,
    "mlflow": _mlflow,
    "wandb": _wandb,
}
