"""Raw files of Prophesee cameras: the text header, the sensor size, and the way from words to events and back.

A RAW file is a header of ASCII lines that start with `% `, then little-endian words: 32 bits in EVT 2.0, 16 in 3.0.
DAT files start with the same kind of header.

Source: Prophesee, "RAW file format", "EVT 2.0 format" and "EVT 3.0 format" (docs.prophesee.ai, Data encoding formats).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ctlev_core.events.decoding import record_files
from ctlev_core.events.decoding.sensor_sizes import smallest_sensor
from data_contracts.errors import DataError
from data_contracts.events import Events, SensorSize, check_events

WORD_DTYPES = {"EVT2": np.dtype("<u4"), "EVT3": np.dtype("<u2")}
MAX_SENSOR_SIZE = 2048
"""Both encodings give a coordinate 11 bits."""

MAX_LOOPS = 1 << 16
"""A writer spells out every overflow of the camera's clock; more than this (12 days in EVT3) is a clock that was never
reset, such as unix time, and would only fill the file."""

# Headers of Metavision before 2.2 name the camera, not its geometry.
_SENSOR_BY_GENERATION = {"3": (640, 480), "4": (1280, 720)}
_KNOWN_SENSORS = ((304, 240), (320, 320), (640, 480), (1280, 720))
_MAX_HEADER_BYTES = 1 << 16


@dataclass(frozen=True)
class Header:
    """The text before the words.

    Attributes:
        encoding: `EVT2`, `EVT3`, another name such as `EVT21`, or empty where the header names none.
        fields: the first value of each key, as text.
        size: bytes before the first word.
    """

    encoding: str
    fields: dict[str, str]
    size: int


def read_header(path: Path) -> Header:
    """Parse the header; a file that does not start with `% ` has an empty one of size 0."""
    with path.open("rb") as file:
        head = file.read(_MAX_HEADER_BYTES)
    fields: dict[str, str] = {}
    size = 0
    while head.startswith(b"% ", size):
        stop = head.find(b"\n", size) + 1 or len(head)
        key, _, value = head[size + 2 : stop].decode("ascii", errors="replace").strip().partition(" ")
        fields.setdefault(key, value.strip())
        size = stop
        if key == "end":
            break
    return Header(_encoding(fields), fields, size)


def _encoding(fields: dict[str, str]) -> str:
    if "format" in fields:
        return fields["format"].split(";")[0].upper()
    version = re.fullmatch(r"(\d)\.(\d)", fields.get("evt", ""))
    if version is None:
        return ""
    major, minor = version.groups()
    return f"EVT{major}" if minor == "0" else f"EVT{major}{minor}"


def sniff(path: Path, encoding: str) -> bool:
    """Does the header name this encoding?"""
    return read_header(path).encoding == encoding


def read(path: Path, encoding: str) -> Events:
    """Read a RAW file; see the format plug-ins for what each encoding promises.

    Args:
        path: the file.
        encoding: `EVT2` or `EVT3`; the header must agree.
    Raises:
        DataError: another encoding, no words, a cut word, an unknown sensor, or events that break `check_events`.
    """
    return record_files.read(_open(path, encoding))


def read_chunks(path: Path, num_events: int, encoding: str) -> Iterator[Events]:
    """The events of `read` in chunks of `num_events`; where the header tells no sensor size, the file is read twice.

    Raises:
        DataError: as `read`.
    """
    return record_files.read_chunks(_open(path, encoding), num_events)


def check_complete(path: Path, encoding: str) -> None:
    """Raise `DataError` where the file ends within its header or a word."""
    _open(path, encoding).num_records()


def _open(path: Path, encoding: str) -> record_files.RecordFile:
    from ctlev_core.events.decoding import prophesee_decoding as decoding

    header = read_header(path)
    if header.encoding != encoding:
        raise DataError(f"{path}: expected an {encoding} header, got {header.encoding or 'none'}")
    if header.fields.get("endianness", "little") != "little":
        raise DataError(f"{path}: expected little-endian words, the header says {header.fields['endianness']!r}")
    is_evt2 = encoding == "EVT2"
    return record_files.RecordFile(
        path,
        header.size,
        WORD_DTYPES[encoding],
        items=1,
        unit=f"{encoding} word",
        decode=decoding.decode_evt2 if is_evt2 else decoding.decode_evt3,
        own_state=decoding.EVT2_STATE if is_evt2 else decoding.EVT3_STATE,
        sensor_size=stated_sensor_size(header) or guess_sensor_size(path),
        count_events=None if is_evt2 else decoding.count_evt3,
    )


def stated_sensor_size(header: Header) -> SensorSize | None:
    """Geometry from the header, else of the camera named there; None without either."""
    fields = header.fields
    stated = re.fullmatch(r"(\d{1,5})x(\d{1,5})", fields.get("geometry", ""))
    if stated:
        return int(stated[1]), int(stated[2])
    width, height = (re.search(rf";{name}=(\d{{1,5}})\b", fields.get("format", "")) for name in ("width", "height"))
    if width and height:
        return int(width[1]), int(height[1])
    width, height = (re.fullmatch(r"\d{1,5}", fields.get(name, "")) for name in ("Width", "Height"))
    if width and height:
        return int(width[0]), int(height[0])
    generation = re.search(r"gen(\d)", fields.get("plugin_name", "")) or re.match(r"(\d)", fields.get("generation", ""))
    return _SENSOR_BY_GENERATION.get(generation[1]) if generation else None


def guess_sensor_size(path: Path) -> Callable[[np.ndarray, int], SensorSize]:
    """For a header that tells no size: the smallest known sensor that holds all coordinates."""

    def sensor_size(state: np.ndarray, num_events: int) -> SensorSize:
        if num_events == 0:
            raise DataError(
                f"{path}: neither the header nor any event tells the sensor size, expected '% geometry WxH'"
            )
        largest_x, largest_y = int(state[record_files.LARGEST_X]), int(state[record_files.LARGEST_Y])
        return smallest_sensor(largest_x, largest_y, str(path), _KNOWN_SENSORS)

    return sensor_size


def write(path: Path, events: Events, encoding: str) -> None:
    """Write events as EVT2 or EVT3, EVT3 with vectors where they take fewer words; `read` returns them unchanged.

    Raises:
        DataError: events break `check_events`, the sensor is wider than 11 bits, or the time stamps start too late.
    """
    from ctlev_core.events.decoding import prophesee_encoding

    check_events(events, f"events to be written to {path}")
    width, height = events.sensor_size
    if max(width, height) > MAX_SENSOR_SIZE:
        raise DataError(f"{path}: {encoding} holds sensors up to 2048 x 2048 px, got {width} x {height}")
    time_bits = 34 if encoding == "EVT2" else 24
    loops = int(events.t[-1]) >> time_bits if len(events) else 0
    if loops > MAX_LOOPS:
        raise DataError(
            f"{path}: t = {events.t[-1]} us is {loops} overflows of the {time_bits}-bit clock of {encoding}, expected "
            f"at most {MAX_LOOPS}; subtract the first time stamp before writing"
        )
    encode = prophesee_encoding.encode_evt2 if encoding == "EVT2" else prophesee_encoding.encode_evt3
    # One TIME_HIGH at the start, two an overflow, and at most a TIME_HIGH, TIME_LOW, Y and X word an event.
    words = np.empty(1 + 2 * loops + 4 * len(events), WORD_DTYPES[encoding])
    count = encode(events.t, events.x, events.y, events.p, words)
    lines = [f"evt {encoding[3]}.0", f"format {encoding};height={height};width={width}", f"geometry {width}x{height}"]
    header = "".join(f"% {line}\n" for line in [*lines, "end"])
    with path.open("wb") as file:
        file.write(header.encode("ascii"))
        words[:count].tofile(file)
