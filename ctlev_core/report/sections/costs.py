"""Where the time went, and what exactly was run: tables of the provenance records."""

from __future__ import annotations

from collections.abc import Sequence

from ctlev_core.provenance.records import Record, versions_of
from ctlev_core.report.page.display_names import stage_name
from ctlev_core.report.page.tables import Cell, Table


def cost_table(records: Sequence[Record]) -> Table:
    """Time and memory by stage, the most expensive first."""
    totals: dict[str, list[float]] = {}
    for record in records:
        entry = totals.setdefault(record.stage, [0, 0.0, 0.0, 0.0, 0.0])
        entry[0] += 1
        entry[1] += record.wall_seconds
        entry[2] += record.cpu_seconds
        entry[3] = max(entry[3], record.wall_seconds)
        entry[4] = max(entry[4], record.process_peak_memory_mib)
    wall, cpu = (sum(entry[column] for entry in totals.values()) for column in (1, 2))
    body: list[list[Cell]] = [
        [stage_name(name), int(runs), _seconds(seconds), f"{seconds / wall:.0%}" if wall else "", _seconds(of_cpu),
         _seconds(most), round(peak)]
        for name, (runs, seconds, of_cpu, most, peak) in sorted(totals.items(), key=lambda item: -item[1][1])
    ]  # fmt: skip
    columns = ["stage", "runs", "seconds", "share", "CPU seconds", "longest run, s", "peak memory of its process, MiB"]
    caption = (
        f"{len(records)} stages took {wall:.0f} s and {cpu:.0f} CPU seconds when they were computed, which may have "
        "been in an earlier run; stages run side by side where there are cores, so that the whole took less."
    )
    return Table("Where the time went", columns, body, caption=caption)


def _seconds(value: float) -> float:
    return round(value, 1)


def versions_table(records: Sequence[Record]) -> Table:
    """Versions of stages, plug-ins, software and machine."""
    return Table(
        "Versions", ["what", "version"], [[f"`{name}`", version] for name, version in versions_of(records).items()]
    )
