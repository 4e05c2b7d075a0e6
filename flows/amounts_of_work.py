"""How much work stages have, from their options and those of what they are made from: rows, steps, size of images."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from ctlev_core import plugins
from data_contracts.config import DatasetChoice
from tasks.stage import PlannedStage

_RECORDINGS = (
    "num_train_recordings", "num_test_recordings", "num_validation_recordings", "num_condition_recordings",
)  # fmt: skip
_ROWS = ("count", "num_images", "num_frames")
_FRAMES_OF_CONDITIONS = ("sample", "simulate", "decode_pixels")
"""Stages that make a row for each of their conditions."""
_OF_TRAINING_FRAMES = ("condition_frames", "encode_latents")
"""Stages that make a row for each frame of the split `train`."""
_OF_FRAMES = ("ingest", "encode", *_FRAMES_OF_CONDITIONS, *_OF_TRAINING_FRAMES)
"""Stages the rows of whose tables are recordings or frames."""

_TWO_SAMPLE_TESTS = ("realism", "realism_floors", "sequence_realism")
"""Stages that spend their time on networks which tell sets of frames apart."""


@dataclass(frozen=True)
class Rows:
    """Of a stage's table: those of the split `train`, and all."""

    training: float
    total: float


class Amounts:
    """Rows and work of the stages of a plan.

    Args:
        stages: by key, with all that they are made from.
        made: rows of tables that are there already, by key.
    """

    def __init__(self, stages: Mapping[str, PlannedStage], made: Mapping[str, int] | None = None) -> None:
        self._stages, self._made = stages, made or {}
        self._rows: dict[str, Rows] = {}
        self._sizes: dict[str, tuple[int, int] | None] = {}

    def image_size(self, key: str) -> tuple[int, int] | None:
        """(width, height) px of the images that a stage makes or is made from, the largest; None = they have none."""
        if key not in self._sizes:
            self._sizes[key] = None  # a loop there cannot be, but records are files
            arguments = self._stages[key].arguments if key in self._stages else {}
            sizes = [*_image_sizes(arguments), *filter(None, map(self.image_size, inputs_of(arguments)))]
            self._sizes[key] = max(sizes, key=math.prod, default=None)
        return self._sizes[key]

    def rows(self, key: str) -> Rows:
        """Of a stage; where nothing tells, as many as its largest input has."""
        if key not in self._rows:
            self._rows[key] = Rows(1.0, 1.0)
            stage = self._stages.get(key)
            if stage is not None:
                rows = self._estimate(stage)
                total = float(self._made.get(key, rows.total)) if stage.stage in _OF_FRAMES else rows.total
                self._rows[key] = Rows(rows.training * total / max(rows.total, 1.0), total)
        return self._rows[key]

    def work(self, key: str) -> float:
        """Of a training steps times batch, of a sampling frames times steps, of scores the frames that a model sees, of
        two-sample tests their number, of a report one; else rows.
        """
        stage = self._stages.get(key)
        arguments = {} if stage is None else stage.arguments
        if stage is not None and stage.stage in _TWO_SAMPLE_TESTS:
            return self._two_sample_tests(stage.stage, arguments)
        if stage is not None and stage.stage == "report":
            return 1.0  # a page is not longer for the frames that its numbers are of
        if stage is not None and stage.stage == "score_model":
            frames = self.rows(arguments["data"]["manifest"])
            held_out = frames.total - frames.training
            return held_out if arguments.get("split") != "train" and held_out else frames.total
        numbers = dict(_numbers(arguments))
        if "num_steps" in numbers:
            factors = "num_steps", "batch_size", "sequence_length", "gradient_accumulation"
            return math.prod(numbers.get(name, 1.0) for name in factors)
        guided = 1 + sum(numbers.get(name, 1.0) > 1 for name in ("guidance_scale", "autoguidance_scale"))
        return self.rows(key).total * numbers.get("num_inference_steps", 1.0) * guided

    def _two_sample_tests(self, stage: str, arguments: Mapping[str, Any]) -> float:
        """How many there are: each takes the same time for any number of frames, and of few frames there is none."""
        from ctlev_core.realism.two_sample import MIN_FRAMES

        recorded = self.rows(arguments["frames"]["manifest"])
        train, held_out = recorded.training, recorded.total - recorded.training
        generated = [self.rows(key).total for key in inputs_of({"generated": arguments.get("generated")})]
        smaller = [] if stage == "realism" else [train / 2, held_out / 2, min(train, held_out)]
        smaller += [min(rows, against) for rows in generated for against in (train, held_out)]
        if "length" in arguments:  # of stretches; time in random order is one more
            smaller = [rows / arguments["length"] for rows in (*smaller, train)]
        return float(sum(rows >= MIN_FRAMES for rows in smaller))

    def _estimate(self, stage: PlannedStage) -> Rows:
        numbers = dict(_numbers(stage.arguments))
        inputs = {name: self.rows(value["manifest"]) for name, value in stage.arguments.items() if _is_input(value)}
        if stage.stage == "take_recorded" and "frames" in inputs:
            before = inputs["frames"]
            taken = min(numbers.get("count", before.training), before.training)
            return Rows(taken, before.total - before.training + taken)
        if (asked := next((numbers[name] for name in _ROWS if name in numbers), None)) is not None:
            return Rows(asked, asked)
        if any(name in numbers for name in _RECORDINGS):
            counts = [numbers.get(name, 0.0) for name in _RECORDINGS]
            return Rows(counts[0], sum(counts))
        if isinstance(dataset := stage.given.get("dataset"), DatasetChoice):
            return _recordings(dataset)
        if stage.stage in _FRAMES_OF_CONDITIONS and "conditions" in inputs:
            return inputs["conditions"]
        if stage.stage in _OF_TRAINING_FRAMES and "frames" in inputs:
            return Rows(inputs["frames"].training, inputs["frames"].training)
        before = max(map(self.rows, inputs_of(stage.arguments)), key=lambda rows: rows.total, default=Rows(1.0, 1.0))
        windows = numbers.get("max_windows", 1.0) if "windows" in stage.arguments else 1.0
        return Rows(before.training * windows, before.total * windows)


def inputs_of(arguments: Mapping[str, Any]) -> list[str]:
    """Keys of a stage's inputs."""
    values = [value if isinstance(value, list) else [value] for value in arguments.values()]
    return [item["manifest"] for items in values for item in items if _is_input(item)]


def _is_input(value: Any) -> bool:
    return isinstance(value, dict) and set(value) == {"manifest"}


def _recordings(choice: DatasetChoice) -> Rows:
    """Recordings with events or event images; of a dataset of poses alone, all."""
    plugin = plugins.load_options(choice)
    listed = plugin.module.list_recordings(plugin.options)
    with_data = [one for one in listed if one.has_events or one.has_event_images]
    counts = Counter(part.split for one in with_data or listed for part in one.parts)
    return Rows(float(counts["train"]), float(counts.total()))


def _numbers(value: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """Numbers within nested options by their last names; of one name the outermost."""
    if isinstance(value, Mapping):
        found = sorted(value.items(), key=lambda item: isinstance(item[1], Mapping), reverse=True)
        for key, item in found:  # mappings first, so that what is outermost overwrites
            yield from _numbers(item, str(key))
    elif isinstance(value, int | float) and not isinstance(value, bool) and value > 0:
        yield name, float(value)


def _image_sizes(value: Any) -> Iterator[tuple[int, int]]:
    """Values of options `image_size` that are a width and a height."""
    if not isinstance(value, Mapping):
        return
    for name, item in value.items():
        if name == "image_size" and isinstance(item, list | tuple) and len(item) == 2:
            yield int(item[0]), int(item[1])
        else:
            yield from _image_sizes(item)
