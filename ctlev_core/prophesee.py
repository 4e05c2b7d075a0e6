"""Raw files of Prophesee cameras: the text header, the sensor size, and the way from words to events and back.

A RAW file is a header of ASCII lines that start with `% `, then little-endian words: 32 bits in EVT 2.0, 16 in 3.0.

Source: Prophesee, "RAW file format", "EVT 2.0 format" and "EVT 3.0 format" (docs.prophesee.ai, Data encoding formats).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_contracts.errors import DataError
from data_contracts.events import EVENT_DTYPES, Events, SensorSize, check_events

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
    from ctlev_core import prophesee_decoding

    header = read_header(path)
    if header.encoding != encoding:
        raise DataError(f"{path}: expected an {encoding} header, got {header.encoding or 'none'}")
    words = _open_words(path, header)
    if encoding == "EVT2":
        capacity, decode = prophesee_decoding.count_evt2(words), prophesee_decoding.decode_evt2
    else:
        capacity, decode = prophesee_decoding.count_evt3(words), prophesee_decoding.decode_evt3
    t, x, y, p = (np.empty(capacity, dtype) for dtype in EVENT_DTYPES.values())
    count = decode(words, t, x, y, p)
    t, x, y, p = t[:count], x[:count], y[:count], p[:count]
    return check_events(Events(t, x, y, p, _sensor_size(header, x, y, str(path))), str(path))


def _open_words(path: Path, header: Header) -> np.ndarray:
    """The words as a view of the mapped file, so that a recording larger than memory needs room for its events only."""
    dtype = WORD_DTYPES[header.encoding]
    if header.fields.get("endianness", "little") != "little":
        raise DataError(f"{path}: expected little-endian words, the header says {header.fields['endianness']!r}")
    num_bytes = path.stat().st_size - header.size
    if num_bytes == 0:
        raise DataError(f"{path}: the file ends after its {header.size}-byte header, expected {header.encoding} words")
    if num_bytes % dtype.itemsize:
        raise DataError(
            f"{path}: cut inside a word: {num_bytes} bytes after the header, "
            f"expected a multiple of {dtype.itemsize} for {header.encoding}"
        )
    return np.asarray(np.memmap(path, dtype, mode="c", offset=header.size))


def _sensor_size(header: Header, x: np.ndarray, y: np.ndarray, where: str) -> SensorSize:
    """Geometry from the header, else the named camera, else the smallest known sensor that holds all coordinates."""
    fields = header.fields
    stated = re.fullmatch(r"(\d+)x(\d+)", fields.get("geometry", ""))
    if stated:
        return int(stated[1]), int(stated[2])
    width, height = (re.search(rf";{name}=(\d+)", fields.get("format", "")) for name in ("width", "height"))
    if width and height:
        return int(width[1]), int(height[1])
    generation = re.search(r"gen(\d)", fields.get("plugin_name", "")) or re.match(r"(\d)", fields.get("generation", ""))
    if generation and generation[1] in _SENSOR_BY_GENERATION:
        return _SENSOR_BY_GENERATION[generation[1]]
    if len(x) == 0:
        raise DataError(f"{where}: neither the header nor any event tells the sensor size, expected '% geometry WxH'")
    largest_x, largest_y = int(x.max()), int(y.max())
    for width, height in _KNOWN_SENSORS:
        if largest_x < width and largest_y < height:
            return width, height
    raise DataError(
        f"{where}: the header has no geometry, and events up to x = {largest_x}, y = {largest_y} px fit none of the "
        f"known sensors {', '.join(f'{width} x {height}' for width, height in _KNOWN_SENSORS)}"
    )


def write(path: Path, events: Events, encoding: str) -> None:
    """Write events as EVT2 or EVT3, one word an event and no vectors; `read` returns them unchanged.

    Raises:
        DataError: events break `check_events`, the sensor is wider than 11 bits, or the time stamps start too late.
    """
    from ctlev_core import prophesee_decoding

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
    encode = prophesee_decoding.encode_evt2 if encoding == "EVT2" else prophesee_decoding.encode_evt3
    # One TIME_HIGH at the start, two an overflow, and at most a TIME_HIGH, TIME_LOW, Y and X word an event.
    words = np.empty(1 + 2 * loops + 4 * len(events), WORD_DTYPES[encoding])
    count = encode(events.t, events.x, events.y, events.p, words)
    lines = [f"evt {encoding[3]}.0", f"format {encoding};height={height};width={width}", f"geometry {width}x{height}"]
    header = "".join(f"% {line}\n" for line in [*lines, "end"])
    with path.open("wb") as file:
        file.write(header.encode("ascii"))
        words[:count].tofile(file)
