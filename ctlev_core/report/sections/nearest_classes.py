"""The table of the report that says what a generator has learnt from is most like what it was asked for."""

from __future__ import annotations

from ctlev_core.report.page.tables import Cell, Table
from data_contracts.manifest import Manifest

_CAPTION = (
    "Classes that no training frame of the generator shows, and those of its training set whose names are most alike "
    "to its own text encoder; in brackets the cosine similarity of the two."
)


def nearest_sections(nearest: Manifest) -> list[Table]:
    """One row an unseen class; from a manifest of the table `nearest_seen`."""
    found: dict[str, list[Cell]] = {}
    for row in nearest.table.to_pylist():
        found.setdefault(row["unseen"], []).append(f"{row['seen']} ({row['similarity']:.2f})")
    if not found:
        return []
    count = max(map(len, found.values()))
    columns = ["never seen", "nearest seen class", *(f"no. {rank}" for rank in range(2, count + 1))]
    return [Table("Nearest seen classes", columns, [[name, *cells] for name, cells in found.items()], caption=_CAPTION)]
