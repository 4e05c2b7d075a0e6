"""Events as text, one row an event: `t x y p` as in the event-camera dataset, or any columns under a header line.

Fields are separated by blanks, tabs, commas or semicolons. Without a header a row is exactly t, x, y, p; a header names
the columns (any name of `event_tables.COLUMN_NAMES`) in any order, and further columns are ignored. Lines that start
with `#` are comments; `# sensor_size WIDTHxHEIGHT` before the first row states the sensor, else it is the smallest
common one that holds all events.

Times are seconds where any of them in the file has a decimal point or an exponent, else microseconds, and are rounded
to the nearest microsecond of what is written (never through a binary float). In a column whose name ends in `_us` they
are whole microseconds. Polarity is {0, 1}, {-1, 1} or True and
False.

Source: Mueggler et al., The Event-Camera Dataset and Simulator, IJRR 2017 (events.txt).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ctlev_core.events.decoding import event_chunks, event_tables
from ctlev_core.events.decoding.sensor_sizes import smallest_sensor
from data_contracts.errors import DataError
from data_contracts.events import EVENT_DTYPES, Events, SensorSize, check_events

VERSION = 2
SUFFIXES = (".csv", ".txt")
HOLDS_SIGNAL = True
HAS_SIGNATURE = False
"""Any text of four columns of numbers looks like this: asked only where no other format is recognised."""

_BLOCK_BYTES = 1 << 22
_SNIFFED_BYTES = 1 << 14
_TEXT = bytes([9, 10, 13, *range(32, 127)])
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_SEPARATORS = re.compile(r"[ \t,;\r]+")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|true|false", re.IGNORECASE)


@dataclass(frozen=True)
class _Layout:
    """What precedes the first row: where rows start, which column each field is, and the sensor where stated."""

    offset: int
    names: tuple[str | None, ...]
    sensor_size: SensorSize | None
    says_us: bool = False


def sniff(path: Path) -> bool:
    """Is it text whose first row is four numbers, or a header with names for t, x, y and p?"""
    with path.open("rb") as file:
        head = file.read(_SNIFFED_BYTES).removeprefix(_BYTE_ORDER_MARK)
    if not head or head.translate(None, _TEXT):
        return False
    try:
        return _find_layout(path) is not None
    except DataError:  # a header that lacks one column: reading it says which
        return True


def read(path: Path) -> Events:
    """The whole file.

    Raises:
        DataError: no rows, a row with too few or too many fields or with something else than numbers (named by its
            line), or events that break `check_events`.
    """
    return event_chunks.concatenate(_chunks(path))


def read_chunks(path: Path, num_events: int) -> Iterator[Events]:
    """The events of `read` in chunks; the file is read twice, first for its sensor and its unit of time.

    Raises:
        DataError: as `read`.
    """
    return event_chunks.regroup(_chunks(path), num_events)


def write(path: Path, events: Events) -> None:
    """Write events in microseconds under a header, with the sensor size, so that `read` returns them unchanged.

    Where `Events.signal` is known it is one more column, 1 and 0, which `read` passes over.

    Raises:
        DataError: events break `check_events`.
    """
    check_events(events, f"events to be written to {path}")
    width, height = events.sensor_size
    with path.open("w", encoding="ascii") as file:
        names = (*EVENT_DTYPES, *(["signal"] if events.signal is not None else []))
        file.write(f"# sensor_size {width}x{height}\n{','.join(names)}\n")
        for start in range(0, len(events), 1 << 16):
            part = events.slice(start, start + (1 << 16))
            if part.signal is None:
                rows = zip(part.t.tolist(), part.x.tolist(), part.y.tolist(), part.p.tolist(), strict=True)
                file.writelines(f"{t},{x},{y},{p}\n" for t, x, y, p in rows)
            else:
                columns = (part.t, part.x, part.y, part.p, part.signal.astype(np.uint8))
                rows = zip(*(column.tolist() for column in columns), strict=True)
                file.writelines(",".join(map(str, row)) + "\n" for row in rows)


def _chunks(path: Path) -> Iterator[Events]:
    layout = _find_layout(path)
    if layout is None:
        raise DataError(f"{path}: expected rows of t x y p, or a header line that names these columns")
    has_points, num_rows, sensor_size = False, 0, layout.sensor_size
    largest = np.full(4, -1, np.int64)
    for rows, any_point in _read_rows(path, layout):
        has_points |= any_point
        num_rows += len(rows)
        if len(rows):
            np.maximum(largest, rows.max(0), out=largest)
    if sensor_size is None:
        if num_rows == 0:
            raise DataError(f"{path}: no events, and nothing else tells the sensor size")
        sensor_size = smallest_sensor(int(largest[1]), int(largest[2]), str(path))

    def columns() -> Iterator[event_tables.Columns]:
        num_read = 0
        for rows, _ in _read_rows(path, layout, has_points and not layout.says_us):
            num_read += len(rows)
            yield dict(zip(EVENT_DTYPES, rows.T, strict=True))
        if num_read != num_rows:
            raise DataError(f"{path}: the file changed while it was read: {num_rows} rows first, then {num_read}")

    yield event_chunks.empty_events(sensor_size)
    yield from event_tables.to_events(columns, str(path), sensor_size)


def _find_layout(path: Path) -> _Layout | None:
    """None where the first line that is no comment is neither a header nor four numbers."""
    offset, sensor_size = 0, None
    with path.open("rb") as file:
        head = file.read(_BLOCK_BYTES)
    if head.startswith(_BYTE_ORDER_MARK):
        offset = len(_BYTE_ORDER_MARK)
    while offset < len(head):
        stop = head.find(b"\n", offset) + 1 or len(head)
        line = head[offset:stop].decode("latin-1").strip()
        is_comment = line.startswith("#")
        if is_comment and "sensor_size" in line:
            sensor_size = _stated_size(line, path) or sensor_size
        header = _parse_header(line.removeprefix("#"), path, is_comment) if line else None
        if header:
            named = _field_names(line.removeprefix("#"))[header.index("t")]
            return _Layout(stop, header, sensor_size, event_tables.says_us(named))
        if line and not is_comment:
            fields = [field for field in _SEPARATORS.split(line) if field]
            is_row = len(fields) == 4 and all(_NUMBER.fullmatch(field) for field in fields)
            return _Layout(offset, tuple(EVENT_DTYPES), sensor_size) if is_row else None
        offset = stop
    return None


def _stated_size(line: str, path: Path) -> SensorSize | None:
    """The sensor of a comment; None of one that only speaks of it."""
    before, _, text = line.partition("sensor_size")
    size = event_tables.parse_sensor_size(text.strip(" :=()"))
    if size is None and before.strip() == "#":
        raise DataError(f"{path}: expected the comment '# sensor_size WIDTHxHEIGHT', got {line[:80]!r}")
    return size


def _field_names(line: str) -> list[str]:
    return [name.strip("\"'") for name in _SEPARATORS.split(line) if name]


def _parse_header(line: str, path: Path, is_comment: bool) -> tuple[str | None, ...] | None:
    """Which column each field names; None where the line does not name all four, an error where it names some."""
    names = _field_names(line)
    if not names or any(_NUMBER.fullmatch(name) for name in names):
        return None
    found = {name: column for column, name in event_tables.find_columns(names, str(path)).items()}
    if len(found) < 4:
        if len(found) == 3 and not is_comment:
            event_tables.require_columns(names, f"{path}: header line {line.strip()!r}")
        return None
    return tuple(found.get(name) for name in names)


def _read_rows(path: Path, layout: _Layout, seconds: bool | None = None) -> Iterator[tuple[np.ndarray, bool]]:
    """Rows [M, 4] int64 of t (if its unit is known), x, y, p a block, and whether any t has a point or an exponent."""
    from ctlev_core.events.decoding import text_decoding

    unit = text_decoding.UNKNOWN
    if seconds is not None:
        unit = text_decoding.SECONDS if seconds else text_decoding.MICROSECONDS
    columns = list(EVENT_DTYPES)
    places = np.array([columns.index(name) if name else -1 for name in layout.names], np.int64)
    first_byte, rest = layout.offset, b""
    with path.open("rb") as file:
        file.seek(layout.offset)
        while block := file.read(_BLOCK_BYTES):
            content = rest + block
            end = content.rfind(b"\n") + 1
            if end == 0:
                if len(content) > _BLOCK_BYTES:
                    raise DataError(f"{path}: a line of more than {_BLOCK_BYTES} bytes, expected rows of t x y p")
                rest = content
                continue
            rest = content[end:]
            yield _parse_block(content[:end], places, unit, path, first_byte)
            first_byte += end
    if rest:
        yield _parse_block(rest + b"\n", places, unit, path, first_byte)


def _parse_block(content: bytes, places: np.ndarray, unit: int, path: Path, first_byte: int) -> tuple[np.ndarray, bool]:
    from ctlev_core.events.decoding.text_decoding import parse_rows

    rows = np.empty((content.count(b"\n"), 4), np.int64)
    array = np.frombuffer(content, np.uint8)
    count, error, line_start, field, any_point = parse_rows(array, places, len(places), unit, rows)
    if error:
        stop = content.find(b"\n", line_start)
        line = content[line_start : min(stop, line_start + 80)].decode("ascii", errors="replace").strip()
        problem = (
            "",
            f"field {field + 1} is not a number",
            f"field {field + 1} is not a whole number",
            f"field {field + 1} is too large",
            f"{field} fields, expected {len(places)}",
            f"more than the expected {len(places)} fields",
        )[error]
        raise DataError(f"{path}: row at byte {first_byte + line_start}: {problem}, got {line!r}")
    return rows[:count], any_point
