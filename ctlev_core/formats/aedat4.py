"""AEDAT 4, the files of iniVation's DV software: compressed packets of events, frames, IMU samples and triggers.

Only the event stream is read. Time stamps are the file's own, unix time in microseconds.

Source: iniVation, "AEDAT 4.0 file format"; decoded by the `aedat` package.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_contracts.errors import DataError
from data_contracts.events import Events, check_events

VERSION = 1
SUFFIXES = (".aedat4",)

_MAGIC = b"#!AER-DAT4.0"


def sniff(path: Path) -> bool:
    """Does the file start with the AEDAT 4 version line?"""
    with path.open("rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


def read(path: Path) -> Events:
    """All events of the file's one event stream.

    Raises:
        DataError: a cut or corrupt file, no or several event streams, or events that break `check_events`.
    """
    try:
        streams, packets = _read_packets(path)
    except BaseException as error:
        # The decoder reports a cut file as RuntimeError, but panics on some corrupt ones; that is no Exception.
        if isinstance(error, (KeyboardInterrupt, SystemExit, MemoryError)):
            raise
        raise DataError(f"{path}: not a complete AEDAT 4 file, the decoder says: {error}") from error
    if len(streams) != 1:
        raise DataError(f"{path}: expected one event stream, got {len(streams)}")
    t, x, y, p = (np.concatenate([packet[name] for packet in packets] or [[]]) for name in ("t", "x", "y", "on"))
    # Past 2^63 the unsigned stamps of a corrupt file turn negative, which the check reports.
    columns = (t.astype(np.int64), x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8))
    return check_events(Events(*columns, (streams[0]["width"], streams[0]["height"])), str(path))


def _read_packets(path: Path) -> tuple[list[dict], list[np.ndarray]]:
    import aedat

    decoder = aedat.Decoder(str(path))
    streams = [stream for stream in decoder.id_to_stream().values() if stream["type"] == "events"]
    return streams, [packet["events"] for packet in decoder if "events" in packet]
