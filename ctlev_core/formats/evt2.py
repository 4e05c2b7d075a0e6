"""Prophesee EVT 2.0: a text header, then one 32-bit word an event.

Time stamps are the file's own, not shifted to zero. The sensor size is the header's; older recordings state none, then
the camera named there decides (third generation 640 x 480, fourth 1280 x 720 px), and without a known camera the
smallest of 304 x 240, 320 x 320, 640 x 480 and 1280 x 720 px that holds all events.

Source: Prophesee, "EVT 2.0 format", docs.prophesee.ai.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from ctlev_core.events.decoding import prophesee
from data_contracts.events import Events

VERSION = 1
HAS_SIGNATURE = True
SUFFIXES = (".raw", ".evt2")


def sniff(path: Path) -> bool:
    """Does the header say EVT 2.0?"""
    return prophesee.sniff(path, "EVT2")


def read(path: Path) -> Events:
    """The whole file.

    Raises:
        DataError: a header without words, a cut word, an unknown sensor size, events outside the sensor, or time
            that runs backwards (an overflow of the 34-bit clock is not).
    """
    return prophesee.read(path, "EVT2")


def read_chunks(path: Path, num_events: int) -> Iterator[Events]:
    """The events of `read` in chunks; without a sensor size in the header, the file is read twice.

    Raises:
        DataError: as `read`.
    """
    return prophesee.read_chunks(path, num_events, "EVT2")


def check_complete(path: Path) -> None:
    """Raise `DataError` where the file is cut, as far as can be told without decoding it."""
    prophesee.check_complete(path, "EVT2")


def write(path: Path, events: Events) -> None:
    """Write events so that `read` returns them unchanged.

    Raises:
        DataError: the sensor has more than 2048 px a side, or time stamps past 65,536 overflows of the clock.
    """
    prophesee.write(path, events, "EVT2")
