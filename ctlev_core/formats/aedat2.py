"""AEDAT 2.0 of one camera (jAER): DAVIS and DVS128.

Polarity events are read; frame samples, inertial data and special events are skipped. The image is upright, as jAER
shows it: the camera's addresses count columns from the right and rows from the bottom, so both are turned round. The
header names the camera and so the sensor size; without a name, addresses past 16 bits tell a DAVIS, and its size is the
smallest of 240 x 180, 346 x 260 and 640 x 480 px that holds all events. Files in which several cameras share the
addresses, as in DHP19, are for the dataset `dhp19`.

Source: iniVation, "AEDAT file formats"; addresses and directions as in jAER, DavisBaseCamera and DVS128 extractors.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ctlev_core.events.decoding import aedat2, record_files
from ctlev_core.events.decoding.sensor_sizes import INIVATION_CAMERAS, smallest_sensor
from data_contracts.errors import DataError
from data_contracts.events import Events, SensorSize, check_events

VERSION = 1
HAS_SIGNATURE = True
SUFFIXES = (".aedat", ".aedat2")

_UNNAMED_SENSORS = tuple(INIVATION_CAMERAS[name] for name in ("DAVIS240", "DAVIS346", "DAVIS640"))
_SPECIAL_EVENT = 0x400
_LONGEST_GAP_US, _MAX_FILLERS = 1 << 30, 1 << 16


def sniff(path: Path) -> bool:
    """Does the file start with the version line of AEDAT 2.0?"""
    return aedat2.sniff(path)


def read(path: Path) -> Events:
    """The whole file.

    Raises:
        DataError: no records, a cut one, an unknown or several cameras, events outside the sensor, or time that runs
            backwards (an overflow of the 32-bit clock does not).
    """
    return record_files.read(_open(path))


def read_chunks(path: Path, num_events: int) -> Iterator[Events]:
    """The events of `read` in chunks; the file is read twice, first to see that it is of one camera.

    Raises:
        DataError: as `read`.
    """
    return record_files.read_chunks(_open(path), num_events)


def check_complete(path: Path) -> None:
    """Raise `DataError` where the file is cut, as far as can be told without decoding it."""
    aedat2.check_size(path, aedat2.read_header(path))


def _open(path: Path) -> record_files.RecordFile:
    from ctlev_core.events.decoding import aedat2_decoding as decoding

    header = aedat2.read_header(path)
    num_records = aedat2.check_size(path, header)
    known = re.match("|".join(INIVATION_CAMERAS), header.chip.upper())
    if header.chip and not known:
        raise DataError(f"{path}: unknown camera {header.chip!r}; known: {', '.join(INIVATION_CAMERAS)}")
    layout = decoding.DVS128 if known and known[0] == "DVS128" else decoding.DAVIS

    def sensor_size(state: np.ndarray, num_events: int) -> SensorSize:
        largest_address = int(state[decoding.LARGEST_ADDRESS])
        num_cameras = int(state[decoding.CAMERAS]).bit_count()
        if num_cameras > 1:
            raise DataError(
                f"{path}: the addresses are of {num_cameras} cameras, expected one; for recordings of DHP19 use the "
                f"dataset dhp19"
            )
        if layout == decoding.DVS128 and largest_address > 0xFFFF:
            raise DataError(f"{path}: a DVS128 has 16-bit addresses, got {largest_address:#x}")
        if known:
            return INIVATION_CAMERAS[known[0]]
        if largest_address <= 0xFFFF:
            raise DataError(
                f"{path}: the header names no camera, and none of the {num_records} addresses passes 16 bits: expected "
                f"a line '# AEChip: ...' with one of {', '.join(INIVATION_CAMERAS)}"
            )
        return smallest_sensor(
            int(state[record_files.LARGEST_X]), int(state[record_files.LARGEST_Y]), str(path), _UNNAMED_SENSORS
        )

    own_state = (0, 0, 0, 0, layout)
    dtype = np.dtype(np.uint32)
    return record_files.RecordFile(
        path, header.size, dtype, 2, "record", decoding.decode_aedat2, own_state, sensor_size, finish=_turn_round
    )


def _turn_round(events: Events) -> Events:
    width, height = events.sensor_size
    # In place: the columns are this reader's own.
    np.subtract(width - 1, events.x, out=events.x)
    np.subtract(height - 1, events.y, out=events.y)
    return events


def write(path: Path, events: Events) -> None:
    """Write events of a DAVIS so that `read` returns them unchanged.

    Raises:
        DataError: events break `check_events`, there are none, the sensor is no DAVIS, or the time stamps start too
            late.
    """
    check_events(events, f"events to be written to {path}")
    chips = {size: name for name, size in INIVATION_CAMERAS.items() if name.startswith("DAVIS")}
    if events.sensor_size not in chips:
        raise DataError(
            f"{path}: AEDAT 2.0 is written for sensors of {', '.join(f'{w} x {h}' for w, h in chips)} px, got "
            f"{events.sensor_size[0]} x {events.sensor_size[1]}"
        )
    if len(events) == 0:
        raise DataError(f"{path}: the format cannot hold a recording without events")
    width, height = events.sensor_size
    columns, rows = (width - 1 - events.x).astype(np.uint32), (height - 1 - events.y).astype(np.uint32)
    addresses = rows << 22 | columns << 12 | events.p.astype(np.uint32) << 11
    # The reader sees an overflow as a drop by more than half the clock: special events bridge longer gaps.
    gaps = np.diff(events.t, prepend=0) // _LONGEST_GAP_US
    if gaps.sum() > _MAX_FILLERS:
        raise DataError(
            f"{path}: t = {events.t[-1]} us is {events.t[-1] >> 32} overflows of a 32-bit clock; subtract the first "
            f"time stamp before writing"
        )
    records = np.empty((len(events) + int(gaps.sum()), 2), ">u4")
    place = np.arange(len(events)) + np.cumsum(gaps)
    records[place, 0], records[place, 1] = addresses, events.t & 0xFFFFFFFF
    for event in np.flatnonzero(gaps):
        count, before = int(gaps[event]), int(events.t[event - 1]) if event else 0
        times = before + _LONGEST_GAP_US * np.arange(1, count + 1)
        bridge = slice(place[event] - count, place[event])
        records[bridge, 0], records[bridge, 1] = _SPECIAL_EVENT, times & 0xFFFFFFFF
    lines = [
        "#!AER-DAT2.0",
        f"# AEChip: eu.seebetter.ini.chips.davis.{chips[events.sensor_size]}",
        "#End Of ASCII Header",
    ]
    with path.open("wb") as file:
        file.write("".join(f"{line}\r\n" for line in lines).encode("ascii"))
        records.tofile(file)
