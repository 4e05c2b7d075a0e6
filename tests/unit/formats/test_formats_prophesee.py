"""Prophesee's EVT 2.0 and EVT 3.0: independent slow decoders, one rule at a time, headers, and broken files."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from format_helpers import make_events, to_rows
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core import plugins
from ctlev_core.events import files as event_files
from ctlev_core.events.decoding import prophesee, prophesee_decoding, record_files
from data_contracts.errors import DataError
from data_contracts.events import Events

REAL = Path(__file__).resolve().parents[3].parent / "shared" / "real" / "events"
REAL_AEDAT4 = REAL / "person" / "tonic_sample.aedat4"
REAL_EVT2 = REAL / "spot" / "expelliarmus_evt2.raw"
REAL_EVT3 = REAL / "street" / "expelliarmus_evt3.raw"
needs_real = pytest.mark.skipif(not REAL.is_dir(), reason="the real recordings are not beside the project")
SIZE = (640, 480)


def write_raw(path: Path, encoding: str, words: list[int], header: str = "% geometry 640x480\n") -> Path:
    text = f"% evt {encoding[3]}.0\n{header}"
    path.write_bytes(text.encode("latin-1") + np.array(words, prophesee.WORD_DTYPES[encoding]).tobytes())
    return path


def slow_evt2(words: list[int]) -> list[tuple[int, int, int, int]]:
    """EVT 2.0 as the specification tells it, with the clock kept in one number instead of loops and high bits."""
    clock = None
    rows = []
    for word in words:
        kind = word >> 28
        if kind == 0x8:
            new = (word & 0x0FFFFFFF) * 64
            if clock is not None:
                new += clock // 2**34 * 2**34
                if clock - new > 2**33:
                    new += 2**34
            clock = new
        elif kind in (0, 1) and clock is not None:
            rows.append((clock + (word >> 22) % 64, (word >> 11) % 2048, word % 2048, kind))
    return rows


def slow_evt3(words: list[int]) -> list[tuple[int, int, int, int]]:  # noqa: C901 one case a word type
    """EVT 3.0 as the specification tells it; the same remark."""
    clock = row = vector = None
    low = 0
    rows = []

    def fire(x: int, polarity: int) -> None:
        if clock is not None and row is not None:
            rows.append((clock + low, min(x, 65535), row, polarity))

    for word in words:
        kind, payload = divmod(word, 4096)
        match kind:
            case 0x0:
                row = payload % 2048
            case 0x2:
                fire(payload % 2048, payload // 2048)
            case 0x3:
                vector = (payload % 2048, payload // 2048)
            case 0x4 | 0x5 if vector is not None:
                length = 12 if kind == 0x4 else 8
                for bit in range(length):
                    if payload & (1 << bit):
                        fire(vector[0] + bit, vector[1])
                vector = (vector[0] + length, vector[1])
            case 0x6:
                low = payload
            case 0x8:
                new = payload * 4096
                if clock is not None:
                    new += clock // 2**24 * 2**24
                    if clock - new > 2**23:
                        new += 2**24
                if new != clock:
                    low = 0
                clock = new
    return rows


def decode(encoding: str, words: list[int], block: int = 1 << 30) -> list[tuple[int, int, int, int]]:
    """The compiled decoder without the checks of `read`, for words in any order; `block` words at a time."""
    array = np.array(words, prophesee.WORD_DTYPES[encoding])
    own_state = getattr(prophesee_decoding, f"{encoding}_STATE")
    state = np.array([0] * record_files.NUM_SHARED + list(own_state), np.int64)
    rows: list[tuple[int, int, int, int]] = []
    for start in range(0, len(array), block):
        part = array[start : start + block]
        count = prophesee_decoding.count_evt3(part) if encoding == "EVT3" else len(part)
        t, x, y, p = (np.empty(count, dtype) for dtype in (np.int64, np.uint16, np.uint16, np.uint8))
        written = getattr(prophesee_decoding, f"decode_{encoding.lower()}")(part, state, t, x, y, p)
        assert written <= count
        rows += to_rows(Events(t[:written], x[:written], y[:written], p[:written], SIZE))
    if rows:  # what the decoder says of its events is what spares a check of each
        t, x, y, _ = (list(column) for column in zip(*rows, strict=True))
        went_back = t[0] < 0 or any(late < early for early, late in pairwise(t))
        assert state[: record_files.NUM_SHARED].tolist() == [t[-1], went_back, max(x), max(y)]
    return rows


@needs_real
@pytest.mark.parametrize(("path", "slow"), [(REAL_EVT2, slow_evt2), (REAL_EVT3, slow_evt3)], ids=["evt2", "evt3"])
def test_real_words_decode_as_in_the_slow_decoder(path, slow):
    encoding = prophesee.read_header(path).encoding
    words = np.frombuffer(path.read_bytes()[prophesee.read_header(path).size :], prophesee.WORD_DTYPES[encoding])
    assert to_rows(event_files.read_events_file(path)) == slow(words.tolist())


# Words, one rule at a time --------------------------------------------------------------------------------


def test_evt3_example_of_an_incomplete_vector():
    # prophesee-ai/openeb issue 111: words and the output of Prophesee's standalone decoder (x, y, p, t).
    words = [0x8000, 0x6001, 0x0000, 0x2000, 0x300A, 0x4001, 0x4000, 0x80FF, 0x2001]
    assert decode("EVT3", words) == [(1, 0, 0, 0), (1, 10, 0, 0), (1044480, 1, 0, 0)]


def test_evt3_vectors_advance_by_their_length():
    words = [0x8000, 0x6005, 0x0007, 0x3800 | 100, 0x4801, 0x4002, 0x5081, 0x5001]
    assert [(x, p) for _, x, _, p in decode("EVT3", words)] == [
        (100, 1),
        (111, 1),
        (113, 1),
        (124, 1),
        (131, 1),
        (132, 1),
    ]


def test_evt3_time_low_that_jumps_ahead_and_back_is_no_overflow():
    # As in the real street recording: TIME_HIGH again, TIME_LOW 811, at once TIME_LOW 800.
    words = [0x8B2D, 0x631F, 0x0000, 0x2001, 0x8B2D, 0x632B, 0x6320, 0x2002]
    base = 0xB2D << 12
    assert [t for t, *_ in decode("EVT3", words)] == [base + 799, base + 800]


def test_evt3_a_repeated_time_high_keeps_the_low_time():
    words = [0x8001, 0x6010, 0x0000, 0x2001, 0x8001, 0x2002, 0x8002, 0x2003]
    assert [t for t, *_ in decode("EVT3", words)] == [4096 + 16, 4096 + 16, 8192]


def test_evt3_clock_overflows_at_24_bits():
    words = [0x8FFF, 0x6FFF, 0x0000, 0x2001, 0x8000, 0x6000, 0x2001, 0x8FFE, 0x2001, 0x8000, 0x2001]
    assert [t for t, *_ in decode("EVT3", words)] == [2**24 - 1, 2**24, 2**25 - 8192, 2**25]


def test_evt2_clock_overflows_at_34_bits():
    words = [0x8FFFFFFF, 0x1FC00000, 0x80000000, 0x00000000]
    assert decode("EVT2", words) == [(2**34 - 1, 0, 0, 1), (2**34, 0, 0, 0)]


def test_events_before_time_row_or_base_are_known_are_skipped():
    assert decode("EVT2", [0x10000000, 0x80000000, 0x10000001]) == [(0, 0, 1, 1)]
    assert decode("EVT3", [0x0001, 0x2001, 0x8000, 0x4FFF, 0x2002, 0x3005, 0x4001]) == [(0, 2, 1, 0), (0, 5, 1, 0)]
    assert decode("EVT3", [0x8000, 0x2001]) == []


def test_triggers_and_reserved_words_are_skipped():
    assert decode("EVT3", [0x8000, 0x0003, 0x9999, 0xA001, 0x1234, 0xE014, 0xF000, 0x7001, 0x2004]) == [(0, 4, 3, 0)]
    assert decode("EVT2", [0x80000000, 0xA0000001, 0xE0000000, 0xF0000000, 0x20000000, 0x00000003]) == [(0, 0, 3, 0)]


@settings(max_examples=200, deadline=None)
@given(
    st.sampled_from([[], [0x8000, 0x0000, 0x3000]]),
    st.lists(st.tuples(st.sampled_from([0, 2, 3, 4, 5, 6, 8, 9, 15]), st.integers(0, 4095)), max_size=40),
)
def test_evt3_equals_the_slow_decoder_on_any_words(start, pairs):
    words = start + [kind << 12 | payload for kind, payload in pairs]
    assert decode("EVT3", words) == slow_evt3(words)


@settings(max_examples=200, deadline=None)
@given(
    st.sampled_from([[], [0x80000000]]),
    st.lists(st.tuples(st.sampled_from([0, 1, 8, 10]), st.integers(0, 2**28 - 1)), max_size=40),
)
def test_evt2_equals_the_slow_decoder_on_any_words(start, pairs):
    words = start + [kind << 28 | payload for kind, payload in pairs]
    assert decode("EVT2", words) == slow_evt2(words)


@pytest.mark.parametrize("encoding", ["EVT2", "EVT3"])
@settings(max_examples=100, deadline=None)
@given(
    pairs=st.lists(st.tuples(st.sampled_from([0, 1, 2, 3, 4, 5, 6, 8]), st.integers(0, 4095)), max_size=30),
    size=st.integers(1, 7),
)
def test_any_words_decode_the_same_in_blocks_of_any_size(encoding, pairs, size):
    shift, start = (28, [0x80000000]) if encoding == "EVT2" else (12, [0x8000, 0x0000, 0x3000])
    words = start + [kind << shift | payload for kind, payload in pairs]
    assert decode(encoding, words, size) == decode(encoding, words)


# Writers -----------------------------------------------------------------------------------------------------------


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([0, 0, 0, 1, 5000]), st.integers(0, 40), st.sampled_from([0, 0, 1]), st.integers(0, 1)
        ),
        max_size=40,
    )
)
def test_written_vectors_decode_to_the_same_events_in_fewer_words(tmp_path_factory, steps):
    times = np.cumsum([step for step, *_ in steps], dtype=np.int64)
    rows = [(int(t), *rest) for t, (_, *rest) in zip(times, steps, strict=True)]
    path = tmp_path_factory.mktemp("vectors") / "a.raw"
    plugins.load("formats", "evt3").write(path, make_events(rows))
    words = np.fromfile(path, "<u2", offset=prophesee.read_header(path).size).tolist()
    assert slow_evt3(words) == rows
    assert to_rows(event_files.read_events_file(path)) == rows
    kinds = [word >> 12 for word in words]
    singles = sum(kind in (0, 6, 8) for kind in kinds) + len(rows)
    assert len(words) <= singles


@pytest.mark.parametrize("name", ["evt2", "evt3"])
def test_evt_writers_refuse_what_the_format_cannot_hold(name, tmp_path):
    module = plugins.load("formats", name)
    with pytest.raises(DataError, match="up to 2048 x 2048 px, got 2049 x 10"):
        module.write(tmp_path / "file", make_events([(0, 0, 0, 1)], (2049, 10)))
    with pytest.raises(DataError, match="subtract the first time stamp"):
        module.write(tmp_path / "file", make_events([(1_605_537_493_718_345, 0, 0, 1)]))


def test_a_written_header_states_the_geometry(tmp_path):
    plugins.load("formats", "evt3").write(tmp_path / "file", make_events([], (346, 260)))
    header = prophesee.read_header(tmp_path / "file")
    assert header.encoding == "EVT3"
    assert header.fields["geometry"] == "346x260"


# Headers -----------------------------------------------------------------------------------------------------------

ONE_EVENT = {"EVT2": [0x80000000, 0x10000000 | 9 << 11 | 8], "EVT3": [0x8000, 0x0008, 0x2809]}


@pytest.mark.parametrize("encoding", ["EVT2", "EVT3"])
@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("% geometry 346x260\n% end\n", (346, 260)),
        ("% format {0};height=33;width=44\n% end\n", (44, 33)),
        ("% plugin_name hal_plugin_gen41_evk3\n", (1280, 720)),
        ("% plugin_name hal_plugin_gen31_fx3\n", (640, 480)),
        ("% generation 4.2\n", (1280, 720)),
        ("", (304, 240)),
    ],
)
def test_sensor_size_from_the_header(encoding, header, expected, tmp_path):
    path = write_raw(tmp_path / "a.raw", encoding, ONE_EVENT[encoding], header.format(encoding))
    events = event_files.read_events_file(path)
    assert events.sensor_size == expected
    assert to_rows(events) == [(0, 9, 8, 1)]


def test_everything_after_the_end_line_is_words(tmp_path):
    path = write_raw(tmp_path / "a.raw", "EVT3", [], "% end\n% geometry 9x9\n")
    assert prophesee.read_header(path) == prophesee.Header("EVT3", {"evt": "3.0", "end": ""}, 16)


@pytest.mark.parametrize(
    ("x", "y", "expected"),
    [(303, 239, (304, 240)), (304, 239, (320, 320)), (303, 320, (640, 480)), (640, 0, (1280, 720)), (1280, 0, None)],
)
def test_sensor_size_from_the_coordinates(x, y, expected, tmp_path):
    path = write_raw(tmp_path / "a.raw", "EVT2", [0x80000000, x << 11 | y], header="")
    if expected is None:
        with pytest.raises(DataError, match="x = 1280, y = 0 px fit none of the known sensors 304 x 240"):
            event_files.read_events_file(path)
    else:
        assert event_files.read_events_file(path).sensor_size == expected


@pytest.mark.parametrize("encoding", ["EVT2", "EVT3"])
def test_headers_of_any_length_leave_the_words_readable(encoding, tmp_path):
    for padding in range(4):  # words then start on every alignment
        header = "% end" + " " * padding + "\n"
        path = write_raw(tmp_path / f"{padding}.raw", encoding, ONE_EVENT[encoding], header)
        assert to_rows(event_files.read_events_file(path)) == [(0, 9, 8, 1)]


def test_a_valid_file_without_events_is_empty(tmp_path):
    path = write_raw(tmp_path / "a.raw", "EVT3", [0x8000, 0x6001])
    assert len(event_files.read_events_file(path)) == 0
    path = write_raw(tmp_path / "b.raw", "EVT3", [0x8000, 0x6001], header="")
    with pytest.raises(DataError, match=r"b\.raw: neither the header nor any event tells the sensor size"):
        event_files.read_events_file(path)


# Broken files ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["EVT2", "EVT3"])
def test_a_header_without_words_is_an_error(encoding, tmp_path):
    path = write_raw(tmp_path / "a.raw", encoding, [])
    with pytest.raises(DataError, match=rf"a\.raw: the file ends after its 29-byte header, expected {encoding} words"):
        event_files.read_events_file(path)


@pytest.mark.parametrize(("encoding", "cuts"), [("EVT2", (1, 2, 3)), ("EVT3", (1,))])
def test_a_file_cut_inside_a_word_is_an_error(encoding, cuts, tmp_path):
    path = write_raw(tmp_path / "a.raw", encoding, ONE_EVENT[encoding])
    content = path.read_bytes()
    for cut in cuts:
        path.write_bytes(content[:-cut])
        with pytest.raises(DataError, match=r"a\.raw: cut inside a word"):
            event_files.read_events_file(path)


def test_time_that_runs_backwards_names_the_event(tmp_path):
    path = write_raw(tmp_path / "a.raw", "EVT3", [0x8010, 0x0000, 0x2001, 0x800F, 0x2002])
    with pytest.raises(DataError, match=r"a\.raw: t decreases at event 1: 65536 us, then 61440 us"):
        event_files.read_events_file(path)


def test_a_vector_that_runs_off_the_sensor_is_an_error_and_does_not_wrap(tmp_path):
    # 5,500 vectors of 12 pass 2^16 and would come back to column 464 if columns wrapped.
    words = [0x8000, 0x0000, 0x3000, *[0x4000] * 5500, 0x4001]
    path = write_raw(tmp_path / "a.raw", "EVT3", words)
    with pytest.raises(DataError, match=r"a\.raw: x must be below 640, got 65535 at event 0"):
        event_files.read_events_file(path)


def test_big_endian_words_are_refused(tmp_path):
    path = write_raw(tmp_path / "a.raw", "EVT3", [0x8000], "% endianness big\n% geometry 640x480\n")
    with pytest.raises(DataError, match="expected little-endian words, the header says 'big'"):
        event_files.read_events_file(path)
