"""Events as text, written with plain string formatting; seconds against exact decimals."""

from __future__ import annotations

from decimal import Decimal

import pytest
from format_helpers import P, T, X, Y, assert_events, read_both_ways
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ctlev_core import plugins
from ctlev_core.events import files as event_files
from data_contracts.errors import DataError

SECONDS = "".join(f"{t / 1e6:.9f} {x} {y} {p}\n" for t, x, y, p in zip(T, X, Y, P, strict=True))


@pytest.mark.parametrize(
    "text",
    [
        SECONDS,
        SECONDS.removesuffix("\n"),
        SECONDS.replace("\n", "\r\n"),
        SECONDS.replace(" ", ","),
        "# t x y p\n\n" + SECONDS.replace(" ", " ; "),
        "\ufefft,x,y,p\n" + SECONDS.replace(" ", ", "),
        "".join(f"{t / 1e6:.18e}\t{x:.6e} {y}.0 {p}e0\n" for t, x, y, p in zip(T, X, Y, P, strict=True)),
        "".join(f"{t} {x} {y} {2 * p - 1}\n" for t, x, y, p in zip(T, X, Y, P, strict=True)),
        "polarity,Timestamp,row,col,extra\n"
        + "".join(f"{bool(p)},{t},{y},{x},word\n" for t, x, y, p in zip(T, X, Y, P, strict=True)),
    ],
)
def test_text_in_many_styles(text, tmp_path):
    path = tmp_path / "events.txt"
    path.write_text(text, encoding="utf-8", newline="")
    events = read_both_ways(path)
    assert_events(events)
    assert events.sensor_size == (346, 260)


@settings(max_examples=150, deadline=None)
@example(Decimal("8.3757164552060269014E-7"), "f")
@example(Decimal("5.000000000000000000E-7"), "e")
@example(Decimal("5.0000000000000000001E-7"), "f")
@given(st.decimals(0, 9 * 10**11, allow_nan=False, allow_infinity=False), st.sampled_from(["f", "e"]))
def test_text_seconds_are_rounded_exactly(tmp_path_factory, value, style):
    path = tmp_path_factory.mktemp("text") / "a.txt"
    text = format(value, style)
    path.write_text(f"{text}{'' if '.' in text or 'e' in text else '.'} 1 2 0\n")
    expected = int((Decimal(text) * 10**6).quantize(Decimal(1))) if abs(value) > 0 else 0
    assert plugins.load("formats", "csv").read(path).t.tolist() == [expected]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0.1 1 2 1\n0.2 1 2\n", "row at byte 10: 3 fields, expected 4, got '0.2 1 2'"),
        ("0.1 1 2 1\n0.2 1 2 1 7\n", "more than the expected 4 fields"),
        ("0.1 1 2 1\n0.2 1 a 1\n", "field 3 is not a number"),
        ("0.1 1 2 1\n0.2 1.5 2 1\n", "field 2 is not a whole number"),
        ("0.1 1 2 1\n99999999999999999999 1 2 1\n", "field 1 is too large"),
        ("0.1 1 2 1\n0.05 1 2 1\n", "t decreases at event 1: 100000 us, then 50000 us"),
        ("-0.1 1 2 1\n", "t .* whole number from 0"),
        ("nan 1 2 1\n", "not an event file"),
        ("t,x,y\n1,2,3\n", "no column p"),
        ("t,x,y,p\n", "no events, and nothing else tells the sensor size"),
        ("# sensor_size 20x10\n0.1 20 2 1\n", "x must be below 20, got 20 at event 0"),
        ("# sensor_size 20x10\n0.1 19 10 1\n", "y must be below 10, got 10 at event 0"),
        (
            "# sensor_size -20x10\n0.1 2 2 1\n",
            "comment '# sensor_size WIDTHxHEIGHT', got '# sensor_size -20x10'",
        ),
        (
            "# sensor_size: VGA\n0.1 2 2 1\n",
            "comment '# sensor_size WIDTHxHEIGHT', got '# sensor_size: VGA'",
        ),
        ("dear reader, this is no table of events\n", "not an event file"),
        ("1 2 3\n", "not an event file"),
    ],
)
def test_wrong_text_names_the_row(text, message, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(DataError, match=message):
        event_files.read_events_file(path)


def test_text_is_parsed_the_same_across_blocks(tmp_path, monkeypatch):
    module = plugins.load("formats", "csv")
    monkeypatch.setattr(module, "_BLOCK_BYTES", 37)
    path = tmp_path / "a.txt"
    path.write_text(SECONDS)
    assert_events(read_both_ways(path))
    path.write_text("0.1 1 2 1\n" + "0" * 100 + "1 1 2 1\n")
    with pytest.raises(DataError, match="a line of more than 37 bytes"):
        module.read(path)


@pytest.mark.parametrize("stated", ["sensor_size 20x10", "sensor_size: (20, 10)", "the sensor_size = 20 x 10"])
def test_a_comment_states_the_sensor(stated, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(f"# {stated}\n# its sensor_size is that of the camera\n1 2 3 1\n")
    assert read_both_ways(path).sensor_size == (20, 10)


@pytest.mark.parametrize("change", ["shorter", "longer"])
def test_text_that_changes_while_it_is_read_is_an_error(tmp_path, monkeypatch, change):
    reader = plugins.load("formats", "csv")
    monkeypatch.setattr(reader, "_BLOCK_BYTES", 1 << 14)
    path = tmp_path / "a.csv"
    rows = [f"{t} 1 2 1\n" for t in range(10_000, 20_000)]
    path.write_text("".join(rows))
    chunks = reader.read_chunks(path, 10)
    next(chunks)  # the file has been looked through once
    path.write_text("".join(rows[:7000]) if change == "shorter" else "".join([*rows, "20000 1 2 1\n"]))
    with pytest.raises(DataError, match=r"a\.csv: the file changed while it was read: 10000 rows first, then \d+"):
        list(chunks)
