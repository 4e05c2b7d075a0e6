"""Event files of any known format: which format a file has, its events, and what the manifest says of them."""

from __future__ import annotations

import os
from pathlib import Path
from types import ModuleType

from ctlev_core import plugins
from data_contracts.errors import DataError
from data_contracts.events import Events


def find_format(path: Path) -> ModuleType:
    """The one format plug-in whose `sniff` recognises the file's content; the suffix is not asked.

    Formats whose files carry a signature are asked first, all of them. Those without (`HAS_SIGNATURE = False`: a table
    of numbers, ATIS records) recognise what is merely plausible; they are asked only where no signature is found.

    Raises:
        DataError: no such file; no format recognises it, then the message lists the known formats; or several do, then
            it names them.
    """
    if not path.is_file():
        raise DataError(f"{path}: expected an event file, got {'a folder' if path.is_dir() else 'nothing there'}")
    formats = {name: plugins.load("formats", name) for name in plugins.names("formats")}
    for has_signature in (True, False):
        asked = [name for name in formats if getattr(formats[name], "HAS_SIGNATURE", True) == has_signature]
        claims = [name for name in asked if formats[name].sniff(path)]
        if len(claims) > 1:
            raise DataError(f"{path}: could be any of the formats {', '.join(claims)}; expected exactly one to fit")
        if claims:
            return formats[claims[0]]
    known = ", ".join(f"{name} ({', '.join(module.SUFFIXES)})" for name, module in formats.items())
    raise DataError(
        f"{path}: not an event file of a known format ({path.stat().st_size} bytes); known formats: {known}"
    )


def read_events_file(path: Path) -> Events:
    """All events of a file of any known format, checked.

    Raises:
        DataError: see `find_format` and the format's own `read`.
    """
    return find_format(path).read(path)


def write_events_parquet(path: Path, events: Events) -> None:
    """Write events in the project's own format; the file appears under its name only when it is complete."""
    partial = path.with_name(path.name + ".partial")
    plugins.load("formats", "parquet").write(partial, events)
    os.replace(partial, path)


def summarise(events: Events) -> dict[str, int]:
    """What a manifest says of a recording.

    Returns:
        num_events, duration_us, t_first_us, t_last_us, num_positive, num_negative; times are 0 without events.
    """
    num_events = len(events)
    num_positive = int(events.p.sum(dtype="int64"))
    return {
        "num_events": num_events,
        "duration_us": events.duration_us,
        "t_first_us": int(events.t[0]) if num_events else 0,
        "t_last_us": int(events.t[-1]) if num_events else 0,
        "num_positive": num_positive,
        "num_negative": num_events - num_positive,
    }
