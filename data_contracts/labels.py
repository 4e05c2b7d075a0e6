"""Labels, recordings and conditions: the small records that travel between plug-ins and stages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from data_contracts.errors import DataError
from data_contracts.events import SensorSize

SPLITS = ("train", "validation", "test", "condition")
"""`condition`: labels without events, used only as conditions to sample from. Fixed at ingest."""


@dataclass(frozen=True)
class Part:
    """A stretch of a recording and the split it belongs to; `start` and `stop` are fractions of its events."""

    split: str
    start: float = 0.0
    stop: float = 1.0


@dataclass(frozen=True)
class Recording:
    """One recording of a dataset, before anything but its existence is known.

    Attributes:
        recording_id: unique within the dataset; letters, digits, `.`, `_`, `-` and `/`.
        subject: who or what was recorded; splits are by subject wherever a dataset names subjects.
        parts: which split the recording belongs to; more than one part where a recording is split in time.
        class_name: class or motion, empty where the dataset has none.
        sensor_size: (width, height) px; None when only the file itself tells.
        has_events: False for recordings that carry labels only.
        files: raw files the recording is read from; their content enters the cache key.
    """

    recording_id: str
    subject: str
    parts: tuple[Part, ...]
    class_name: str = ""
    sensor_size: SensorSize | None = None
    has_events: bool = True
    files: tuple[Path, ...] = ()


@dataclass(frozen=True, eq=False)
class Labels:
    """N labelled moments: the label track of one recording, or one row per sample of a table.

    Attributes:
        class_names: N class names; empty strings where there is no class.
        t_us: [N] int64, time of each moment, microseconds on the clock of the events.
        joints2d: [N, J, 2] float32, px, (x right, y down), pixel centres at integer + 0.5; NaN = unknown.
        visible: [N, J] bool; False = outside the image, occluded or unknown.
        joint_set: name of the joint order, a key of `ctlev_core.skeletons.JOINT_SETS`; empty without joints.
    """

    class_names: tuple[str, ...]
    t_us: np.ndarray
    joints2d: np.ndarray | None = None
    visible: np.ndarray | None = None
    joint_set: str = ""

    def __len__(self) -> int:
        return len(self.class_names)

    def take(self, rows: Sequence[int] | np.ndarray) -> Labels:
        """The given rows, in the given order."""
        rows = np.asarray(rows, dtype=np.int64)
        return replace(
            self,
            class_names=tuple(self.class_names[row] for row in rows),
            t_us=self.t_us[rows],
            joints2d=None if self.joints2d is None else self.joints2d[rows],
            visible=None if self.visible is None else self.visible[rows],
        )


def check_labels(labels: Labels, where: str) -> Labels:
    """Raise `DataError` unless shapes agree and every joint marked visible is a finite number."""
    count = len(labels)
    if labels.t_us.shape != (count,) or labels.t_us.dtype != np.int64:
        raise DataError(f"{where}: t_us must be [{count}] int64, got {labels.t_us.shape} {labels.t_us.dtype}")
    if (labels.joints2d is None) != (labels.visible is None):
        raise DataError(f"{where}: joints2d and visible must be given together")
    if labels.joints2d is None or labels.visible is None:
        return labels
    if labels.joints2d.ndim != 3 or labels.joints2d.shape[0] != count or labels.joints2d.shape[2] != 2:
        raise DataError(f"{where}: joints2d must be [{count}, J, 2], got {labels.joints2d.shape}")
    if labels.visible.shape != labels.joints2d.shape[:2] or labels.visible.dtype != bool:
        got = f"{labels.visible.shape} {labels.visible.dtype}"
        raise DataError(f"{where}: visible must be {labels.joints2d.shape[:2]} bool, got {got}")
    wrong = labels.visible & ~np.isfinite(labels.joints2d).all(axis=-1)
    if wrong.any():
        row, joint = np.argwhere(wrong)[0]
        value = labels.joints2d[row, joint].tolist()
        raise DataError(f"{where}: joint {joint} of row {row} is marked visible but its position is {value}")
    return labels


@dataclass(frozen=True, eq=False)
class Conditions:
    """What a generator is asked for, one row per image.

    Attributes:
        prompts: N text prompts.
        images: [N, H, W, 3] uint8 condition images, or None for the text route.
    """

    prompts: tuple[str, ...]
    images: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.prompts)


@dataclass
class History:
    """Scalars of a training run, one row per logged step, for the loss curves of the report."""

    step: list[int] = field(default_factory=list)
    loss: list[float] = field(default_factory=list)
    validation_step: list[int] = field(default_factory=list)
    validation_loss: list[float] = field(default_factory=list)
    shuffled_loss: list[float] = field(default_factory=list)
