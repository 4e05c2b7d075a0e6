"""What the tests of event files share: making events, and reading a file whole and in chunks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ctlev_core.events import files as event_files
from ctlev_core.events.decoding import event_chunks
from data_contracts.errors import DataError
from data_contracts.events import Events

SIZE = (640, 480)

T = [0, 5, 5, 1_000_003]
X = [0, 345, 3, 7]
Y = [1, 2, 259, 0]
P = [1, 0, 0, 1]


def assert_events(events: Events, t=T, x=X, y=Y, p=P) -> None:
    assert [events.t.tolist(), events.x.tolist(), events.y.tolist(), events.p.tolist()] == [list(t), x, y, p]


def read_both_ways(path: Path) -> Events:
    """Found by content, read whole and in chunks of three, which must agree."""
    module = event_files.find_format(path)
    events = module.read(path)
    chunks = list(module.read_chunks(path, 3))
    assert all(len(chunk) == 3 for chunk in chunks[:-1])
    joined = event_chunks.concatenate(chunks)
    assert_events(joined, events.t.tolist(), events.x.tolist(), events.y.tolist(), events.p.tolist())
    assert joined.sensor_size == events.sensor_size
    return events


def raises_both_ways(path: Path, match: str) -> None:
    module = event_files.find_format(path)
    with pytest.raises(DataError, match=match):
        module.read(path)
    with pytest.raises(DataError, match=match):
        list(module.read_chunks(path, 3))


def make_events(rows: list[tuple[int, int, int, int]], sensor_size: tuple[int, int] = SIZE) -> Events:
    """Rows of (t, x, y, p) as events."""
    t, x, y, p = np.array(rows, np.int64).reshape(-1, 4).T
    return Events(t.copy(), x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8), sensor_size)


def to_rows(events: Events) -> list[tuple[int, int, int, int]]:
    return list(
        zip(events.t.tolist(), events.x.tolist(), events.y.tolist(), events.p.tolist(), strict=True)
    )  # fmt: skip
