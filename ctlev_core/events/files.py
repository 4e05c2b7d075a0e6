"""Event files of any known format: which format a file has, its events, and what the manifest says of them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType

from ctlev_core import plugins
from ctlev_core.events.decoding import event_chunks
from ctlev_core.plugin_contracts import FormatWithCheck
from data_contracts.errors import DataError
from data_contracts.events import Events, SensorSize

CHUNK_EVENTS = 1 << 20
"""Events a chunk where nothing else is asked for: 13 MiB."""


def find_format(path: Path) -> ModuleType:
    """The one format plug-in whose `sniff` recognises the file's content; the suffix is not asked.

    Formats whose files carry a signature are asked first, all of them. Those without (`HAS_SIGNATURE = False`: a table
    of numbers, ATIS records) recognise what is merely plausible; they are asked only where no signature is found.

    Raises:
        DataError: no such file, or not to be read; no format recognises it, then the message lists the known formats;
            or several do, then it names them.
    """
    if not path.is_file():
        raise DataError(f"{path}: expected an event file, got {'a folder' if path.is_dir() else 'nothing there'}")
    formats = _load_formats()
    if (module := plugins.recognise(formats, path)) is not None:
        return module
    known = ", ".join(f"{name} ({', '.join(module.SUFFIXES)})" for name, module in formats.items())
    raise DataError(
        f"{path}: not an event file of a known format ({path.stat().st_size} bytes); known formats: {known}"
    )


def _load_formats() -> dict[str, ModuleType]:
    return {name: plugins.load("formats", name) for name in plugins.names("formats")}


def check_complete(path: Path) -> None:
    """Raise `DataError` where a file is cut, as far as its format tells without decoding it.

    Files of no known format pass: datasets have readers of their own for them.
    """
    module = plugins.recognise(_load_formats(), path)
    if isinstance(module, FormatWithCheck):
        module.check_complete(path)


def read_events_file(path: Path) -> Events:
    """All events of a file of any known format, checked.

    Raises:
        DataError: see `find_format` and the format's own `read`.
    """
    return find_format(path).read(path)


def read_event_chunks(path: Path, num_events: int = CHUNK_EVENTS) -> Iterator[Events]:
    """The events of a file of any known format in chunks of `num_events`, in memory that does not grow with the file.

    Together the chunks keep the promises of `Events`: times do not descend from one to the next, and all have the same
    sensor size. A recording without events is one empty chunk.

    Raises:
        DataError: see `find_format` and the format's own `read_chunks`; part of the chunks may have been given by then.
    """
    return event_chunks.check_joints(find_format(path).read_chunks(path, num_events), str(path))


def read_events_range(path: Path, start: int, stop: int) -> Events:
    """Events start .. stop - 1 of a file in the project's own format, without reading the rest.

    Raises:
        DataError: no such file or another format, or a range that does not lie in the recording.
    """
    parquet = plugins.load("formats", "parquet")
    if not path.is_file() or not parquet.sniff(path):
        other = find_format(path).__name__.rsplit(".", 1)[-1]
        raise DataError(f"{path}: only parts of Parquet files can be read, got {other}")
    return parquet.read_range(path, start, stop)


def write_events_parquet(path: Path, events: Events) -> None:
    """Write events in the project's own format; the file appears under its name only when it is complete."""
    write_event_chunks_parquet(path, [events])


def write_event_chunks(path: Path, chunks: Iterable[Events], name: str) -> None:
    """Write a recording that comes in chunks in the format of a name.

    Parquet is written chunk by chunk; other formats as a whole, which must fit into memory.

    Raises:
        DataError: the chunks break `check_events` or do not join, or the format cannot hold them.
    """
    if name == "parquet":
        write_event_chunks_parquet(path, chunks)
    else:
        plugins.load("formats", name).write(path, event_chunks.concatenate(chunks))


def write_event_chunks_parquet(path: Path, chunks: Iterable[Events]) -> Summary:
    """Write a recording that comes in chunks in the project's own format, in memory that does not grow with it.

    The file appears under its name only when it is complete; where a chunk is wrong, nothing is left.

    Args:
        path: the file.
        chunks: at least one chunk, all of one sensor size, each starting where the last one ended or later.
    Returns:
        What a manifest says of the whole recording.
    Raises:
        DataError: the chunks break `check_events` or do not join.
    """
    partial = path.with_name(path.name + ".partial")
    summary = Summary()
    try:
        plugins.load("formats", "parquet").write_chunks(partial, summary.watch(chunks))
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    return summary


class Summary:
    """What a manifest says of a recording, gathered chunk by chunk; `sensor_size` is None before the first chunk."""

    def __init__(self) -> None:
        self.sensor_size: SensorSize | None = None
        self.num_events = self.num_positive = self.t_first_us = self.t_last_us = 0

    def add(self, events: Events) -> None:
        """Count the next chunk."""
        self.sensor_size = events.sensor_size
        if len(events) == 0:
            return
        if self.num_events == 0:
            self.t_first_us = int(events.t[0])
        self.t_last_us = int(events.t[-1])
        self.num_events += len(events)
        self.num_positive += int(events.p.sum(dtype="int64"))

    def watch(self, chunks: Iterable[Events]) -> Iterator[Events]:
        """Hand the chunks on, counted."""
        for chunk in chunks:
            self.add(chunk)
            yield chunk

    def result(self) -> dict[str, int]:
        """As `summarise`."""
        return {
            "num_events": self.num_events,
            "duration_us": self.t_last_us - self.t_first_us,
            "t_first_us": self.t_first_us,
            "t_last_us": self.t_last_us,
            "num_positive": self.num_positive,
            "num_negative": self.num_events - self.num_positive,
        }


def summarise(events: Events) -> dict[str, int]:
    """What a manifest says of a recording.

    Returns:
        num_events, duration_us, t_first_us, t_last_us, num_positive, num_negative; times are 0 without events.
    """
    summary = Summary()
    summary.add(events)
    return summary.result()
