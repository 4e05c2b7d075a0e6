"""Runs of consecutive images: as long as asked for, never across a gap, stacked as single samples are."""

from __future__ import annotations

import numpy as np
import pandas
import pyarrow as pa
import pytest
import torch
from generated_frames import REJECTED_ROW, make_generated, make_streams, publish
from torch.utils.data import DataLoader

from ctlev_core.export.event_dataset import EventDataset
from ctlev_core.export.event_sequences import EventSequences
from data_contracts import tables
from data_contracts.errors import DataError
from tasks.export_images import write_image_folder

SOURCES = [f"a:{20 * number}" for number in range(4)] + ["b:0", "b:20", "b:60"]
"""Row 1 is one that the quality filter rejected."""


@pytest.fixture
def dataset(tmp_path):
    images = EventDataset(make_generated(tmp_path / "home").synthetic, rejected=True)
    place = images.table.column_names.index("source_id")
    images.table = images.table.set_column(place, "source_id", pa.array(SOURCES))
    return images


@pytest.mark.parametrize(
    ("length", "step", "expected"),
    [
        (2, None, [0, 2, 4]),
        (2, 1, [0, 1, 2, 4]),
        (3, None, [0]),
        (3, 1, [0, 1]),
        (4, 3, [0]),
        (1, None, [0, 1, 2, 3, 4, 5, 6]),
    ],
)
def test_runs_do_not_cross_gaps(dataset, length, step, expected):
    sequences = EventSequences(dataset, length, step=step)
    assert len(sequences) == len(expected)
    for sample, start in zip(sequences, expected, strict=True):
        assert sample["sample_id"] == [f"synthetic/{row:06d}" for row in range(start, start + length)]
        for offset in range(length):
            single = dataset[start + offset]
            for name, value in single.items():
                if isinstance(value, torch.Tensor):
                    torch.testing.assert_close(sample[name][offset], value, rtol=0, atol=0, equal_nan=True)
                else:
                    assert sample[name][offset] == value
        assert sample["image"].shape == (length, 3, 14, 20) and sample["seed"].shape == (length,)


def test_an_image_that_is_left_out_ends_a_run(tmp_path, dataset):
    kept = EventDataset(dataset.place)
    rows = [row for row in range(7) if row != REJECTED_ROW]
    place = kept.table.column_names.index("source_id")
    kept.table = kept.table.set_column(place, "source_id", pa.array([SOURCES[row] for row in rows]))
    names = [sample["sample_id"] for sample in EventSequences(kept, 2)]
    assert names == [["synthetic/000002", "synthetic/000003"], ["synthetic/000004", "synthetic/000005"]]


@pytest.mark.parametrize("with_events", [False, True])
def test_runs_of_an_exported_folder_are_those_of_its_labels(tmp_path, with_events):
    home = tmp_path / "home"
    made = make_generated(home)
    artefacts = dict(made.artefacts)
    if with_events:
        _, columns = make_streams(made, home, "streams", a_file=1)
        artefacts["event streams"] = publish(
            home, "export_events", "streams", columns, tables.EVENT_STREAMS, {"generated": made.synthetic}
        )
    folder = write_image_folder(artefacts, tmp_path / "mine", name="walks", notice="")
    labels = pandas.read_parquet(folder / "labels.parquet")
    labels["source_id"] = [SOURCES[row] for row in range(7) if row != REJECTED_ROW]
    labels.to_parquet(folder / "labels.parquet")
    names = [sample["sample_id"] for sample in EventSequences(EventDataset(folder), 2)]
    assert names == [["synthetic/000002", "synthetic/000003"], ["synthetic/000004", "synthetic/000005"]]


def test_batches_and_a_transform(dataset):
    sequences = EventSequences(dataset, 2, transform=lambda sample: sample["image"].mean(dim=(1, 2, 3)))
    (batch,) = DataLoader(sequences, batch_size=3)
    assert batch.shape == (3, 2)
    np.testing.assert_allclose(batch[1, 0], dataset[2]["image"].mean(), rtol=1e-6)


def test_what_cannot_be_is_refused(tmp_path, dataset):
    with pytest.raises(DataError, match="no 5 images follow one another, the longest run has 4"):
        EventSequences(dataset, 5)
    with pytest.raises(ValueError, match="length and step must be 1 or more, got 2 and 0"):
        EventSequences(dataset, 2, step=0)
    single = EventDataset(make_generated(tmp_path / "other").synthetic)
    with pytest.raises(DataError, match="no two frames follow one another"):
        EventSequences(single, 2)
    with pytest.raises(ValueError, match="give the transform to EventSequences"):
        EventSequences(EventDataset(dataset.place, transform=len), 2)
