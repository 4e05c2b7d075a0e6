"""A finished experiment of a few tiny frames, as manifests, for tests of the report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ctlev_core.realism.distances import DISTRIBUTIONS
from ctlev_core.realism.stretches import SHUFFLED
from ctlev_core.report.inputs import GeneratedFrames, Named, ReportInputs
from ctlev_core.scoring.memorisation import CLOSEST_PAIRS
from data_contracts import tables
from data_contracts.labels import Labels
from data_contracts.manifest import Manifest, ManifestRef, label_columns, read_manifest, write_manifest

SIDE, COUNT, METRIC = 12, 12, "mpjpe2d_px"
STRETCH, STEP_US = 4, 1
"""Labels to sample from are 1 us apart."""
CLASSES = ["walk", "run"] * (COUNT // 2)
TRAINING_SETS = {
    "recorded": 0.0,
    "synthetic": 0.3,
    "gan": 0.8,
    "recorded+synthetic": -0.5,
    "recorded+gan": 0.1,
    "recorded+oracle": -1.0,
}
TRAINING_SETS |= {"recorded+synthetic@0.5": -0.25}


class Experiment:
    """Writes artefacts into `<home>/artefacts` and keeps what the report takes."""

    def __init__(self, home: Path, seeds: tuple[int, ...] = (0, 1)) -> None:
        self.home, self.seeds, self._count = home, seeds, 0
        self.recordings = self._put("ingest", _recordings(), tables.RECORDINGS)
        self.frames = self._frames()
        self.frame_conditions = self._conditions("frame", "condition_frames")
        self.conditions = self._conditions("asked", "condition_samples")
        self.checkpoints = [self._training("finetune") for _ in range(2)]
        self.generated = [self._synthetic(checkpoint) for checkpoint in self.checkpoints]
        self.model_names = [f"{name}, seed {seed}" for name in TRAINING_SETS for seed in seeds]
        self.models = [self._training("train_downstream") for _ in self.model_names]
        self.scores = self._scores()
        no_rows = tables.SCORES.arrow().empty_table()
        beside = {DISTRIBUTIONS.name: DISTRIBUTIONS.arrow().empty_table()}
        self.event_realism = self._put("event_realism", no_rows, tables.SCORES, beside)
        self.realism_floors = self._put("realism_floors", _tests("test against test"), tables.TWO_SAMPLE_TESTS)
        self.realism = [self._realism(name) for name in ("synthetic", "gan")]
        self.memorisation = [self._memorisation(name) for name in ("synthetic", "gan")]
        arguments = {"length": STRETCH, "step_us": STEP_US}
        beside = {tables.TWO_SAMPLE_TESTS.name: _stretch_tests()}
        self.sequences = self._put("sequence_realism", _sequences(), tables.SCORES, beside, (), arguments)

    @property
    def inputs(self) -> ReportInputs[Manifest]:
        """For `tasks.report.report`."""
        names = ("synthetic", "gan")
        return ReportInputs(
            title="tiny",
            notice="Data: `made up`.",
            training_sets=tuple(TRAINING_SETS),
            recordings=self.recordings,
            frames=self.frames,
            frame_conditions=self.frame_conditions,
            conditions=self.conditions,
            generated=tuple(map(GeneratedFrames, names, self.generated, self.memorisation, self.realism)),
            checkpoints=tuple(map(Named, names, self.checkpoints)),
            models=tuple(map(Named, self.model_names, self.models)),
            scores=tuple(self.scores),
            event_realism=self.event_realism,
            realism_floors=self.realism_floors,
        )

    def _realism(self, name: str) -> Manifest:
        group = "frames" if name == "synthetic" else f"frames of {name}"
        beside = {
            DISTRIBUTIONS.name: _distributions(group),
            tables.TWO_SAMPLE_TESTS.name: _tests(f"{name} against recorded", group),
        }
        return self._put("realism", _realism(name, group), tables.SCORES, beside)

    def _put(self, stage: str, table: pa.Table, schema, attached=(), arrays=(), arguments=(), inputs=()) -> Manifest:
        self._count += 1
        key = f"{self._count:032x}"
        folder = self.home / "artefacts" / stage / key
        folder.mkdir(parents=True)
        for name, array in dict(arrays).items():
            np.save(folder / f"{name}.npy", array)
        for name, content in dict(attached).items():
            pq.write_table(content, folder / f"{name}.parquet")
        ref = write_manifest(folder, table.cast(schema.arrow()), schema)
        record = {
            "stage": stage, "stage_version": 1, "key": key, "digest": ref.digest, "arguments": dict(arguments),
            "upstream": {manifest.ref.key: manifest.ref.digest for manifest in inputs}, "versions": {"ctlev": "0"},
            "started": "2026-01-01T00:00:00Z", "wall_seconds": 1.5, "cpu_seconds": 1.0, "process_peak_memory_mib": 90.0,
        }  # fmt: skip
        (folder / "run.json").write_text(json.dumps(record))
        return read_manifest(ManifestRef(key=key, path=folder))

    def _frames(self) -> Manifest:
        split = ["train"] * (COUNT // 2) + ["test"] * (COUNT // 2)
        columns = {
            "sample_id": [f"frame{row}" for row in range(COUNT)], "recording_id": [f"r{row}" for row in range(COUNT)],
            "subject": ["someone"] * COUNT, "split": split, "class_name": CLASSES, "t_start_us": [0] * COUNT,
            "t_end_us": [20_000] * COUNT, "t_us": [10_000] * COUNT, "num_events": [50] * COUNT,
            **label_columns(_labels()),
        }  # fmt: skip
        arrays = {"frames": _pictures(0)}
        inputs = {"arguments": {"recordings": _input(self.recordings)}, "inputs": [self.recordings]}
        return self._put("encode", pa.table(columns), tables.FRAMES, arrays=arrays, **inputs)

    def _conditions(self, name: str, stage: str) -> Manifest:
        count = COUNT // 2 if name == "frame" else COUNT
        rows = slice(0, count)
        columns = {
            "sample_id": [f"{name}{row}" for row in range(count)], "source_id": [f"r0:{row}" for row in range(count)],
            "subject": ["someone"] * count, "class_name": CLASSES[rows], "prompt": ["A moving human"] * count,
            "t_start_us": [0] * count, "t_end_us": [20_000] * count, **label_columns(_labels().take(np.arange(count))),
        }  # fmt: skip
        arguments = {"condition": {"plugin": "conditions/skeleton", "version": 1, "options": {}}}
        arrays = {"images": _pictures(1)[rows]}
        return self._put(stage, pa.table(columns), tables.CONDITIONS, arrays=arrays, arguments=arguments)

    def _synthetic(self, checkpoint: Manifest) -> Manifest:
        columns = {
            "sample_id": [f"made{row}" for row in range(COUNT)], "recording_id": [f"made{row}" for row in range(COUNT)],
            "condition_id": [f"asked{row}" for row in range(COUNT)], "source_id": [f"r0:{row}" for row in range(COUNT)],
            "subject": ["someone"] * COUNT, "split": ["train"] * COUNT, "class_name": CLASSES, "prompt": ["p"] * COUNT,
            "generator": ["g"] * COUNT, "checkpoint_digest": ["c"] * COUNT, "scheduler": ["ddim"] * COUNT,
            "num_inference_steps": pa.array([4] * COUNT, pa.int32()), "guidance_scale": [1.0] * COUNT,
            "seed": [0] * COUNT, "num_attempts": pa.array([1] * COUNT, pa.int32()), "rejected": [""] * COUNT,
            **label_columns(_labels()),
        }  # fmt: skip
        table = pa.table(columns).select([column.name for column in tables.SYNTHETIC.columns])
        inputs = {"arguments": {"checkpoint": _input(checkpoint)}, "inputs": [checkpoint]}
        return self._put("sample", table, tables.SYNTHETIC, arrays={"frames": _pictures(2)}, **inputs)

    def _training(self, stage: str) -> Manifest:
        rows = [(curve, step, 1.0 / step) for curve in ("training", "validation", "shuffled") for step in (1, 2, 3)]
        columns = dict(zip(("curve", "step", "loss"), map(list, zip(*rows, strict=True)), strict=True))
        inputs = {"arguments": {"training_sets": [_input(self.frames)]}, "inputs": [self.frames]}
        return self._put(stage, pa.table(columns), tables.TRAINING, **inputs)

    def _scores(self) -> list[Manifest]:
        tested = self.frames.rows_where(split="test")
        names = [self.frames.column("sample_id")[row] for row in tested]
        found = []
        for model, name in zip(self.models, self.model_names, strict=True):
            training_set, seed = name.split(", seed ")
            values = 6 + np.arange(len(names)) / 10 + TRAINING_SETS[training_set] + 0.01 * int(seed)
            rows = [_score(training_set, int(seed), float(values.mean()), model, self.frames)]
            rows += [{**rows[0], "group": "walk"}, {**rows[0], "group": "classes with recorded training frames"}]
            columns = {"sample_id": names, "recording_id": names, "metric": [rows[0]["metric"]] * len(names)}
            samples = pa.table({**columns, "value": values, "weight": np.ones(len(names))})
            found.append(self._score_artefact(rows, model, {tables.SAMPLE_SCORES.name: samples}))
        model = self.models[0]
        for training_set, value in (
            ("label agreement of synthetic", 5.0),
            ("shuffled label agreement of synthetic", 15.0),
        ):
            found.append(self._score_artefact([_score(training_set, 0, value, model, self.generated[0])], model))
        distance = {**_score("synthetic", 0, 9.0, model, self.generated[0]), "task": "distance", "metric": "fd_event_x"}
        return [*found, self._score_artefact([distance], model)]

    def _score_artefact(self, rows: list[dict], model: Manifest, attached=()) -> Manifest:
        table = pa.Table.from_pylist(rows, schema=tables.SCORES.arrow())
        arguments = {"model": _input(model), "training_sets": [_input(self.frames)], "split": "test"}
        inputs = {"arguments": arguments, "inputs": [model, self.frames]}
        return self._put("score_model", table, tables.SCORES, attached, **inputs)

    def _memorisation(self, name: str) -> Manifest:
        row = {
            **_score(name, 0, 0.0, self.models[0], self.generated[0]),
            "task": "memorisation",
            "metric": "close_share",
        }
        pair = {
            "subject": name, "features": "small pictures", "generated_id": "made0", "training_id": "frame0",
            "generated_row": 0, "training_row": 0, "distance": 0.5, "threshold": 1.0,
        }  # fmt: skip
        table = pa.Table.from_pylist([{**row, "group": "small pictures"}], schema=tables.SCORES.arrow())
        pairs = pa.Table.from_pylist([pair], schema=CLOSEST_PAIRS.arrow())
        return self._put("memorisation", table, tables.SCORES, {CLOSEST_PAIRS.name: pairs})


def _input(manifest: Manifest) -> dict[str, str]:
    return {"manifest": manifest.ref.key}


def _labels() -> Labels:
    joints = np.tile(np.float32([[3, 3], [8, 8]]), (COUNT, 1, 1))
    joints = np.concatenate([joints] * 7, axis=1)[:, :13]
    visible = np.ones(joints.shape[:2], bool)
    return Labels(tuple(CLASSES), np.zeros(COUNT, np.int64), joints2d=joints, visible=visible, joint_set="dhp19")


def _pictures(seed: int) -> np.ndarray:
    """Picture i has i + 1 rows with something in them."""
    pictures = np.random.default_rng(seed).integers(1, 255, (COUNT, SIDE, SIDE, 1), np.uint8).repeat(3, axis=-1)
    for number, picture in enumerate(pictures):
        picture[number + 1 :] = 0
    return pictures


def _recordings() -> pa.Table:
    row = {
        "subject": "someone", "class_name": "walk", "splits": "train", "sensor_width_px": SIDE,
        "sensor_height_px": SIDE,
        "num_events": 100, "num_positive": 60, "num_negative": 40, "t_first_us": 0, "t_last_us": 1, "duration_us": 1,
        "num_windows": None, "events_file": "", "events_batch": None, "event_images_file": "", "intensity_file": "",
    }  # fmt: skip
    rows = [{**row, "recording_id": f"r{number}"} for number in range(COUNT)]
    return pa.Table.from_pylist(rows, schema=tables.RECORDINGS.arrow())


def _score(training_set: str, seed: int, value: float, model: Manifest, data: Manifest) -> dict:
    return {
        "task": "pose2d", "subject": training_set, "seed": seed, "group": "all", "metric": METRIC, "value": value,
        "low": value - 0.1, "high": value + 0.1, "num_samples": 6,
        "num_train": {"recorded": 6, "recorded+synthetic@0.5": 12}.get(training_set, 18),
        "model_digest": model.ref.digest, "data_digest": data.ref.digest,
    }  # fmt: skip


def _realism(name: str, group: str) -> pa.Table:
    same = {"task": "realism", "seed": 0, "low": None, "high": None, "num_samples": 6, "num_train": 0}
    same |= {"model_digest": "", "data_digest": "", "group": group, "metric": "active_pixel_share"}
    rows = [{**same, "subject": one, "value": 0.5} for one in ("recorded", name, f"{name} against recorded")]
    return pa.Table.from_pylist(rows, schema=tables.SCORES.arrow())


def _distributions(group: str) -> pa.Table:
    row = {"group": group, "subject": "recorded", "axis": "value", "centre": 30.0, "share": 1.0}
    return pa.Table.from_pylist([row], schema=DISTRIBUTIONS.arrow())


def _tests(subject: str, group: str = "frames") -> pa.Table:
    unknown = dict.fromkeys(("value", "low", "high", "deviation"))
    row = {"group": group, "subject": subject, "num_first": 12, "num_second": 6, **unknown}
    return pa.Table.from_pylist([{**row, "note": "too few frames"}], schema=tables.TWO_SAMPLE_TESTS.arrow())


def _sequences() -> pa.Table:
    same = {"task": "realism", "seed": 0, "num_samples": 6, "num_train": 0, "model_digest": "", "data_digest": ""}
    numbers = {
        "recorded": {"rate_correlation_lag1": 0.75, "persistent_share": 0.5},
        SHUFFLED: {"rate_correlation_lag1": 0.0, "persistent_share": 0.25},
        "test": {"rate_correlation_lag1": 0.5},
        "synthetic": {"rate_correlation_lag1": 0.125, "persistent_share": 0.375},
        "gan": {"persistent_share": 0.125},
    }
    rows = [
        {**same, "group": "sequences", "subject": name, "metric": metric, "value": value, "low": low, "high": high}
        for name, of_set in numbers.items()
        for metric, value in of_set.items()
        for low, high in [(None, None) if name == "gan" else (value - 0.125, value + 0.125)]
    ]
    area = {**same, "group": "sequences", "subject": "synthetic against test", "metric": "c2st", "value": 0.75}
    rows.append({**area, "low": 0.625, "high": 0.875})
    return pa.Table.from_pylist(rows, schema=tables.SCORES.arrow())


def _stretch_tests() -> pa.Table:
    same = {"group": "sequences", "num_first": 50, "num_second": 50, "note": ""}
    areas = {
        f"{SHUFFLED} against recorded": (0.875, 0.75, 1.0, 0.0625),
        "synthetic against test": (0.75, 0.625, 0.875, 0.0625),
        "gan against test": (None, None, None, None),
    }
    rows = [
        {**same, "subject": name, **dict(zip(("value", "low", "high", "deviation"), area, strict=True))}
        for name, area in areas.items()
    ]
    rows[-1]["note"] = "fewer than 40 frames in a set"
    return pa.Table.from_pylist(rows, schema=tables.TWO_SAMPLE_TESTS.arrow())
