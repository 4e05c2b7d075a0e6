"""The plan of a run with what each stage takes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ctlev_core.duration_text import duration_text
from flows.memory_use import fitting_processes
from flows.stage_costs import StageCost, compare_stages, estimate_stages, time_left
from flows.tables_of_text import print_table
from tasks.stage import PlannedStage


def print_plan_with_costs(rows: Sequence[PlannedStage], home: Path) -> None:
    """A line for each stage: cached or to run, time, memory, disk and key; then the totals of what is to run, and how
    what has finished compares with what was predicted.
    """
    stages = {row.key: row for row in rows}
    costs = estimate_stages(rows, home)
    table = [
        ["cached" if row.cached else "to run", *_cells(costs[key], is_cached=row.cached), key[:12], row.label]
        for key, row in stages.items()
    ]
    columns = ["", "time", "memory", "disk", "key", "stage"]
    print_table(f"plan, in {home}", columns, table, right=(1, 2, 3))
    asked = [key for key, row in stages.items() if not row.cached]
    _print_comparison(rows, home)
    print(f"{len(stages) - len(asked)} of {len(stages)} stages are cached")
    known = [cost for key in asked if (cost := costs[key]) is not None]
    if not known:
        if asked:
            print("nothing like the others was run before: no estimate")
        return
    workers = fitting_processes(rows, costs)
    left = time_left(rows, costs, {}, workers)
    print(
        f"the rest: about {duration_text(left)} with {workers} process{'es' * (workers > 1)}, "
        f"{max(cost.memory_mib for cost in known) / 1024:.1f} GiB of memory in the largest, "
        f"{_size(sum(cost.disk_bytes for cost in known))} of disk; estimated from earlier runs"
        + (f", without {len(asked) - len(known)} stages like which none was run" if len(known) < len(asked) else "")
    )


def _print_comparison(rows: Sequence[PlannedStage], home: Path) -> None:
    """What finished stages took beside what was predicted for them, a line a stage; nothing where none has finished."""
    compared = compare_stages(rows, home)
    if not compared:
        return
    groups: dict[str, list[tuple[StageCost, StageCost]]] = {}
    for row in {row.key: row for row in rows}.values():
        if row.key in compared:
            groups.setdefault(row.stage, []).append(compared[row.key])
    table = [[name, str(len(group)), *_pairs(group)] for name, group in groups.items()]
    everything = list(compared.values())
    table.append(["all", str(len(everything)), *_pairs(everything)])
    columns = ["stage", "runs", "time", "predicted", "memory", "predicted", "disk", "predicted"]
    print_table("finished stages, measured and predicted", columns, table, right=range(1, len(columns)))


def _pairs(group: Sequence[tuple[StageCost, StageCost]]) -> list[str]:
    """Measured and predicted time, memory and disk of several stages: sums, and the largest memory."""
    cells = []
    for of, show in (
        (lambda costs: sum(cost.seconds for cost in costs), lambda value: f"{value:,.1f} s"),
        (lambda costs: max(cost.memory_mib for cost in costs), lambda value: f"{value:,.0f} MiB"),
        (lambda costs: sum(cost.disk_bytes for cost in costs), _size),
    ):
        cells += [show(of(costs)) for costs in zip(*group, strict=True)]
    return cells


def _cells(cost: StageCost | None, *, is_cached: bool) -> list[str]:
    if cost is None:
        return ["?", "?", "?"]
    about = "" if is_cached else "~"
    return [f"{about}{duration_text(cost.seconds)}", f"{cost.memory_mib:,.0f} MiB", f"{about}{_size(cost.disk_bytes)}"]


def _size(count: float) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.1f} MB"
