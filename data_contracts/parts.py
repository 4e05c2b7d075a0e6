"""Names of recordings that say which dataset of a union they are of: `part.dhp19/S1/session1/mov1`."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pyarrow as pa

from data_contracts.manifest import Manifest

PREFIX = "part."
_NAMED = re.compile(r"part\.([A-Za-z0-9_-]+)/")


def part_of(recording_id: str) -> str:
    """The part that a recording, or a person, is of; empty where it is of no union."""
    found = _NAMED.match(recording_id)
    return "" if found is None else found[1]


def is_part_name(name: str) -> bool:
    """Can a part be called so?"""
    return re.fullmatch(r"[A-Za-z0-9_-]+", name) is not None


def only_part(manifest: Manifest, part: str | None) -> Manifest:
    """Recordings of one part; of frames all rows, of which those of other parts are in no split.

    Rows of frames stay where they are, for row i of an array belongs to row i of the table.

    Args:
        manifest: of recordings, or of frames.
        part: a dataset of a union; None = every one, and the manifest as it is.
    """
    if part is None:
        return manifest
    kept = np.array([part_of(name) == part for name in manifest.column("recording_id")], bool)
    if "split" not in manifest.table.column_names:
        return replace(manifest, table=manifest.table.filter(pa.array(kept)))
    splits = pa.array(np.where(kept, manifest.column("split"), "").tolist(), pa.string())
    place = manifest.table.column_names.index("split")
    return replace(manifest, table=manifest.table.set_column(place, "split", splits))
