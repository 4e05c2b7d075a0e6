"""Prophesee EVT 3.0: a text header, then 16-bit words that change a state (time, row) or add events to it.

Time stamps are the file's own, not shifted to zero. The sensor size is found as in EVT 2.0: the header's geometry, else
the camera named there (third generation 640 x 480, fourth 1280 x 720 px), else the smallest of 304 x 240, 320 x 320,
640 x 480 and 1280 x 720 px that holds all events.

Source: Prophesee, "EVT 3.0 format", docs.prophesee.ai.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from ctlev_core.events.decoding import prophesee
from data_contracts.events import Events

VERSION = 1
HAS_SIGNATURE = True
SUFFIXES = (".raw", ".evt3")


def sniff(path: Path) -> bool:
    """Does the header say EVT 3.0?"""
    return prophesee.sniff(path, "EVT3")


def read(path: Path) -> Events:
    """The whole file.

    Raises:
        DataError: a header without words, a cut word, an unknown sensor size, events outside the sensor, or time
            that runs backwards (an overflow of the 24-bit clock is not).
    """
    return prophesee.read(path, "EVT3")


def read_chunks(path: Path, num_events: int) -> Iterator[Events]:
    """The events of `read` in chunks; without a sensor size in the header, the file is read twice.

    Raises:
        DataError: as `read`.
    """
    return prophesee.read_chunks(path, num_events, "EVT3")


def check_complete(path: Path) -> None:
    """Raise `DataError` where the file is cut, as far as can be told without decoding it."""
    prophesee.check_complete(path, "EVT3")


def write(path: Path, events: Events) -> None:
    """Write events, with vectors where they take fewer words, so that `read` returns them unchanged.

    Raises:
        DataError: the sensor has more than 2048 px a side, or time stamps past 65,536 overflows of the clock.
    """
    prophesee.write(path, events, "EVT3")
