"""What the stages of a plan would take: time, memory and disk, from what such stages took before.

Known are the records of the home (`run.json`: time, peak memory) and, where it has none of the kind, those of
`stage_costs.json`, measured on two cores. Stages are of a kind where they are the same function with the same plug-ins.
Their time and disk are taken as linear in an amount of work that options tell: steps times batch of a training, frames
times steps of a sampling, rows elsewhere.
"""

from __future__ import annotations

import contextlib
import functools
import json
import math
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data_contracts.manifest import RUN_FILE
from tasks.stage import PlannedStage

REFERENCE = Path(__file__).with_name("stage_costs.json")
MAX_RECORDS = 400
"""Of a stage, the newest; to read more says nothing new."""
_RECORDINGS = ("num_train_recordings", "num_test_recordings", "num_condition_recordings")
_ROWS = ("count", "num_images", "num_frames")


@dataclass(frozen=True)
class StageCost:
    """What a stage took or would take.

    Attributes:
        seconds: of wall time, alone on its cores.
        memory_mib: peak of its process.
        disk_bytes: of its artefact.
        is_known: it was measured, not estimated from others.
    """

    seconds: float
    memory_mib: float
    disk_bytes: int
    is_known: bool = False


@dataclass(frozen=True)
class Measured:
    """A stage that was run: its kind, its amount of work, and what it took."""

    kind: str
    work: float
    cost: StageCost


def estimate_stages(rows: Sequence[PlannedStage], home: Path) -> dict[str, StageCost | None]:
    """The cost of every stage of a plan by its key; None where nothing like it was measured. Those cached are known."""
    asked = {row.key: row for row in rows}
    measured = _by_kind(_measured_in(home))
    reference = _by_kind(_reference())
    amounts = _Amounts({row.key: row.arguments for row in rows})
    found: dict[str, StageCost | None] = {}
    for key, row in asked.items():
        folder = home / "artefacts" / row.stage / key
        if row.cached and (record := _read(folder)) is not None:
            found[key] = _cost_of(record, folder)
            continue
        kind = kind_of(row.stage, row.arguments)
        similar = measured.get(kind) or reference.get(kind) or measured.get(row.stage) or reference.get(row.stage)
        found[key] = None if similar is None else _at(similar, amounts.work(key))
    return found


def kind_of(stage: str, arguments: Mapping[str, Any]) -> str:
    """Name of a stage and its plug-ins."""
    return " ".join([stage, *sorted({str(item["plugin"]) for item in arguments.values() if _is_plugin(item)})])


def inputs_of(arguments: Mapping[str, Any]) -> list[str]:
    """Keys of a stage's inputs."""
    values = [value if isinstance(value, list) else [value] for value in arguments.values()]
    return [
        item["manifest"] for items in values for item in items if isinstance(item, dict) and set(item) == {"manifest"}
    ]


def time_left(
    rows: Iterable[PlannedStage], costs: Mapping[str, StageCost | None], done: Mapping[str, float], workers: int
) -> float:
    """Seconds until all stages are done.

    Args:
        rows: of the plan.
        costs: of its stages; those unknown are taken as the median of those known.
        done: seconds that stages have run already, by key; infinite for those that have ended.
        workers: processes that run stages side by side.

    Returns:
        The longer of two bounds: all work shared out evenly, and the longest chain of stages that need one another.
    """
    known = [cost.seconds for cost in costs.values() if cost is not None]
    usual = statistics.median(known) if known else 0.0
    chain: dict[str, float] = {}
    total = 0.0
    for row in rows:  # a plan lists a stage after its inputs
        if row.key in chain:
            continue
        cost = costs.get(row.key)
        left = 0.0 if row.cached else max((usual if cost is None else cost.seconds) - done.get(row.key, 0.0), 0.0)
        total += left
        chain[row.key] = left + max((chain.get(key, 0.0) for key in inputs_of(row.arguments)), default=0.0)
    return max(total / max(workers, 1), max(chain.values(), default=0.0))


def reference_records(home: Path) -> list[list[Any]]:
    """What `stage_costs.json` holds, from the runs of a home: kind, work, seconds, MiB, bytes; two of each kind."""
    groups: dict[str, list[Measured]] = {}
    for one in _measured_in(home, alone=True):
        groups.setdefault(one.kind, []).append(one)
    rows = []
    for kind, group in sorted(groups.items()):
        by_work = {
            round(one.work, 3): one.cost for one in sorted(group, key=lambda one: one.cost.seconds, reverse=True)
        }
        for work in sorted({min(by_work), max(by_work)}):
            cost = by_work[work]
            rows.append([kind, work, cost.seconds, cost.memory_mib, cost.disk_bytes])
    return rows


class _Amounts:
    """Rows and work of stages, from their options and those of what they are made from."""

    def __init__(self, arguments: Mapping[str, Mapping[str, Any]]) -> None:
        self._arguments = arguments
        self._rows: dict[str, float] = {}

    def rows(self, key: str) -> float:
        if key not in self._rows:
            self._rows[key] = 1.0  # a loop there cannot be, but records are files
            self._rows[key] = self._count_rows(self._arguments.get(key, {}))
        return self._rows[key]

    def _count_rows(self, arguments: Mapping[str, Any]) -> float:
        numbers = dict(_numbers(arguments))
        asked = next((numbers[name] for name in _ROWS if name in numbers), None)
        if asked is not None:
            return asked
        if any(name in numbers for name in _RECORDINGS):
            return sum(numbers.get(name, 0.0) for name in _RECORDINGS)
        before = max(map(self.rows, inputs_of(arguments)), default=1.0)
        return before * (numbers.get("max_windows", 1.0) if "windows" in arguments else 1.0)

    def work(self, key: str) -> float:
        numbers = dict(_numbers(self._arguments.get(key, {})))
        if "num_steps" in numbers:
            return math.prod(numbers.get(name, 1.0) for name in ("num_steps", "batch_size", "gradient_accumulation"))
        guided = 2.0 if numbers.get("guidance_scale", 1.0) > 1 else 1.0
        return self.rows(key) * numbers.get("num_inference_steps", 1.0) * guided


def _numbers(value: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """Numbers within nested options by their last names; of one name the outermost."""
    if isinstance(value, Mapping):
        found = sorted(value.items(), key=lambda item: isinstance(item[1], Mapping), reverse=True)
        for key, item in found:  # mappings first, so that what is outermost overwrites
            yield from _numbers(item, str(key))
    elif isinstance(value, int | float) and not isinstance(value, bool) and value > 0:
        yield name, float(value)


def _is_plugin(item: Any) -> bool:
    return isinstance(item, Mapping) and "plugin" in item


def _at(group: Sequence[Measured], work: float) -> StageCost:
    """The cost at an amount of work, on a line through what was measured, or through one and nothing."""
    ordered = sorted(group, key=lambda one: one.work)
    low, high = ordered[0], ordered[-1]
    same = [one for one in ordered if math.isclose(one.work, work, rel_tol=0.05)]
    memory = max(one.cost.memory_mib for one in ordered)
    if same:
        seconds = statistics.median(one.cost.seconds for one in same)
        return StageCost(seconds, memory, int(statistics.median(one.cost.disk_bytes for one in same)))

    def line(of: Any) -> float:
        first, last = float(of(low.cost)), float(of(high.cost))
        if high.work <= 1.05 * low.work or last <= first:
            return last * max(work / max(high.work, 1e-9), 0.2) if work > high.work else min(first, last)
        slope = (last - first) / (high.work - low.work)
        return max(first + slope * (work - low.work), 0.2 * first)

    return StageCost(line(lambda cost: cost.seconds), memory, int(line(lambda cost: cost.disk_bytes)))


def _by_kind(measured: Iterable[Measured]) -> dict[str, list[Measured]]:
    """By kind, and by stage alone."""
    found: dict[str, list[Measured]] = {}
    for one in measured:
        found.setdefault(one.kind, []).append(one)
        if " " in one.kind:
            found.setdefault(one.kind.split(" ")[0], []).append(one)
    return found


def _measured_in(home: Path, *, alone: bool = False) -> list[Measured]:
    """Every stage that was run in a home; `alone`: as fast as if nothing else had used the machine."""
    folders = []
    for stage in (home / "artefacts").glob("*"):
        with contextlib.suppress(OSError):
            newest = sorted(stage.glob(f"*/{RUN_FILE}"), key=lambda path: path.stat().st_mtime, reverse=True)
            folders += [path.parent for path in newest[:MAX_RECORDS]]
    records = {folder.name: (record, folder) for folder in folders if (record := _read(folder)) is not None}
    amounts = _Amounts({key: record["arguments"] for key, (record, _) in records.items()})
    return [
        Measured(
            kind_of(record["stage"], record["arguments"]), amounts.work(key), _cost_of(record, folder, alone=alone)
        )
        for key, (record, folder) in records.items()
    ]


@functools.cache
def _reference() -> list[Measured]:
    if not REFERENCE.is_file():
        return []
    return [Measured(kind, work, StageCost(*cost)) for kind, work, *cost in json.loads(REFERENCE.read_text())]


def _read(folder: Path) -> dict[str, Any] | None:
    """The record of an artefact, None where it cannot be read."""
    try:
        record = json.loads((folder / RUN_FILE).read_text())
        return (
            record
            if {"stage", "arguments", "wall_seconds", "cpu_seconds", "process_peak_memory_mib"} <= record.keys()
            else None
        )
    except (OSError, ValueError, AttributeError):
        return None


def _cost_of(record: Mapping[str, Any], folder: Path, *, alone: bool = False) -> StageCost:
    sizes = (path.stat().st_size for path in folder.rglob("*") if path.is_file())
    # A stage that waited for its core took less processor time than wall time.
    seconds = min(record["wall_seconds"], record["cpu_seconds"]) if alone else record["wall_seconds"]
    return StageCost(seconds, record["process_peak_memory_mib"], sum(sizes), is_known=True)
