"""Stretches of consecutive event images as a PyTorch `Dataset`: for models that look at more than one.

dataset = EventSequences(EventDataset("mine"), length=16)
dataset[0]["image"]                                             # [16, 3, H, W]
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from ctlev_core.export.event_dataset import EventDataset, Sample
from ctlev_core.supervised.frame_sequences import frame_interval_us, name_stretches, stretch_lengths
from data_contracts.errors import DataError
from data_contracts.image_folder import EVENT_COLUMNS


class EventSequences(Dataset[Sample]):
    """Runs of `length` images that follow one another in time: windows of a recording, or labels of one.

    A sample has the keys of an `EventDataset`; arrays and numbers are tensors [length, ...], texts are lists. A run
    ends where a window was left out, where labels jump, and where an image is not in the dataset.

    Args:
        dataset: the images, without a `transform` of its own.
        length: images of a sample.
        step: images from the first of a sample to that of the next of the same run; None = `length`, so that no image
            comes twice.
        transform: from the whole sample to what is returned for it.

    Raises:
        DataError: no images follow one another, or never so many.
        TypeError: `length` or `step` is no whole number.
        ValueError: `length` or `step` is below 1, or the dataset has a transform.
    """

    def __init__(
        self,
        dataset: EventDataset,
        length: int,
        *,
        step: int | None = None,
        transform: Callable[[Sample], Any] | None = None,
    ) -> None:
        step = length if step is None else step
        length, step = operator.index(length), operator.index(step)
        if length < 1 or step < 1:
            raise ValueError(f"length and step must be 1 or more, got {length} and {step}")
        if dataset.transform is not None:
            raise ValueError("give the transform to EventSequences: it takes whole samples, of single images none")
        rows, table = np.arange(len(dataset)), dataset.table
        if EVENT_COLUMNS["file"] in table.column_names:
            # Of an exported folder, whose times are places in files of events and not windows of a recording.
            table = table.drop_columns([EVENT_COLUMNS["t_start_us"], EVENT_COLUMNS["t_end_us"]])
        interval_us = frame_interval_us(table, rows, dataset.place)
        lengths = np.array(stretch_lengths(name_stretches(table, rows, interval_us)))
        starts = [
            np.arange(end - size, end - length + 1, step) for end, size in zip(np.cumsum(lengths), lengths, strict=True)
        ]
        self._starts = np.concatenate(starts)
        if not len(self._starts):
            raise DataError(
                f"{dataset.place}: no {length} images follow one another, the longest run has {max(lengths)}"
            )
        self.dataset, self.length, self.transform = dataset, length, transform

    def __len__(self) -> int:
        return len(self._starts)

    def __getitem__(self, index: int) -> Any:
        start = int(self._starts[range(len(self))[index]])
        samples = [self.dataset[start + number] for number in range(self.length)]
        joined = {name: _stack([sample[name] for sample in samples]) for name in samples[0]}
        return joined if self.transform is None else self.transform(joined)


def _stack(values: list[Any]) -> Any:
    if isinstance(values[0], torch.Tensor):
        return torch.stack(values)
    return values if isinstance(values[0], str) else torch.tensor(values)
