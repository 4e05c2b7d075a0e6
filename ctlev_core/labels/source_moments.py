"""The recording and time that a label to sample from is of."""

from __future__ import annotations


def source_moment(source_id: str) -> tuple[str, int]:
    """Recording and time in us of a source `RECORDING:TIME`; -1 where it names no time."""
    name, _, time = source_id.rpartition(":")
    return name, int(time) if time.isdecimal() else -1
