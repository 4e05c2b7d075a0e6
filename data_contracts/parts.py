"""Names of recordings that say which dataset of a union they are of: `part.dhp19/S1/session1/mov1`."""

from __future__ import annotations

import re

PREFIX = "part."
_NAMED = re.compile(r"part\.([A-Za-z0-9_-]+)/")


def part_of(recording_id: str) -> str:
    """The part that a recording, or a person, is of; empty where it is of no union."""
    found = _NAMED.match(recording_id)
    return "" if found is None else found[1]


def is_part_name(name: str) -> bool:
    """Can a part be called so?"""
    return re.fullmatch(r"[A-Za-z0-9_-]+", name) is not None
