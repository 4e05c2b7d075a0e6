"""What the stages of a plan would take: time, memory and disk, from what such stages took before.

Known are the records of the home (`run.json`: time, peak memory) and, where it has none of the kind, what
`network_costs` calculates for networks of Stable Diffusion's size, or else those of `stage_costs.json`, measured on two
cores. The latter are scaled by how much longer stages that ran here took than there. Stages are of a kind where they
are the same function with the same plug-ins, for images of the same size. Their time and disk are taken as linear in an
amount of work that options tell: steps times batch of a training, frames times steps of a sampling, rows elsewhere.
"""

from __future__ import annotations

import contextlib
import functools
import json
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ctlev_core.provenance.scores import GENERATOR_STAGES
from data_contracts.manifest import RUN_FILE
from flows.amounts_of_work import Amounts, inputs_of
from flows.network_costs import network_cost
from tasks.stage import PlannedStage

REFERENCE = Path(__file__).with_name("stage_costs.json")
MAX_RECORDS = 400
"""Of a stage, the newest; to read more says nothing new."""
NOTICEABLE_S = 1.0
"""Of shorter stages the time says little about a machine."""
USUAL_SIZE = (64, 64)
"""px of the images of the bundled base models."""


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
    records = _records_in(home)
    made = _rows_made(records)
    found = predict_stages([row for row in rows if not row.cached], _measured(records), made, of=rows)
    for row in rows:
        folder = home / "artefacts" / row.stage / row.key
        if row.cached:
            found[row.key] = None if (record := _read(folder)) is None else _cost_of(record, folder)
    return found


def compare_stages(rows: Sequence[PlannedStage], home: Path) -> dict[str, tuple[StageCost, StageCost]]:
    """What finished stages of a plan took, and what would have been said of them in an empty home, by key."""
    records = _records_in(home)
    done = [row for row in rows if row.cached and row.key in records]
    predicted = predict_stages(done, made=_rows_made(records), of=rows)
    return {row.key: (_cost_of(*records[row.key]), cost) for row in done if (cost := predicted[row.key]) is not None}


def predict_stages(
    rows: Sequence[PlannedStage],
    known: Sequence[Measured] = (),
    made: Mapping[str, int] | None = None,
    *,
    of: Sequence[PlannedStage] | None = None,
) -> dict[str, StageCost | None]:
    """The cost of stages by their keys, as if none of them had run; None where nothing is known of their kind.

    Args:
        rows: the stages.
        known: what ran before.
        made: rows of tables that are there, by key.
        of: the whole plan, with what they are made from; None = `rows`.
    """
    measured, reference = _by_kind(known), _by_kind(_reference())
    plan = {row.key: row for row in (rows if of is None else of)}
    amounts, slower = Amounts(plan, made), _times_slower(known, reference)
    found: dict[str, StageCost | None] = {}
    for key, row in {row.key: row for row in rows}.items():
        size = amounts.image_size(key)
        kind = kind_of(row.stage, row.arguments, size)
        similar, calculated = measured.get(kind), None
        if not similar:
            calculated = network_cost(row.stage, row.given, _trained(plan, row), amounts.rows(key).total, size)
        if calculated is not None:
            memory = calculated.memory_bytes / 2**20
            found[key] = StageCost(calculated.seconds(), memory, int(calculated.disk_bytes))
            continue
        places = [(measured, kind), (reference, kind)]
        places += [(table, name) for name in (_without_plugins(kind), row.stage) for table in (measured, reference)]
        table, name = next((place for place in places if place[0].get(place[1])), (None, ""))
        found[key] = None
        if table is not None:
            cost = _at(table[name], amounts.work(key))
            found[key] = replace(cost, seconds=cost.seconds * (slower if table is reference else 1.0))
    return found


def _times_slower(known: Sequence[Measured], reference: Mapping[str, Sequence[Measured]]) -> float:
    """How many times as long as on the machine of `stage_costs.json` stages took here: the median of their kinds."""
    ratios: dict[str, list[float]] = {}
    for one in known:
        if one.kind not in reference or one.cost.seconds < NOTICEABLE_S:
            continue
        there = _at(reference[one.kind], one.work).seconds
        if there >= NOTICEABLE_S:
            ratios.setdefault(one.kind, []).append(one.cost.seconds / there)
    return statistics.median(map(statistics.median, ratios.values())) if ratios else 1.0


def kind_of(stage: str, arguments: Mapping[str, Any], size: tuple[int, int] | None = None) -> str:
    """Name of a stage, its plug-ins, and the size of its images, (width, height) px.

    A classifier for each class is another kind than one for all.
    """
    plugins = [item for item in arguments.values() if _is_plugin(item)]
    binary = [isinstance(item.get("options"), Mapping) and bool(item["options"].get("binary")) for item in plugins]
    names = sorted({str(item["plugin"]) + each * ":binary" for item, each in zip(plugins, binary, strict=True)})
    return " ".join([stage, *names, *([] if size in (None, USUAL_SIZE) else [f"{size[0]}x{size[1]}"])])


def _trained(plan: Mapping[str, PlannedStage], row: PlannedStage) -> Mapping[str, Any]:
    """The arguments of the fine-tuning whose checkpoint a stage samples from."""
    made = [plan[key] for key in inputs_of(row.arguments) if key in plan]
    further = [one for one in made if one.stage in GENERATOR_STAGES and one.stage != "finetune"]
    made += [plan[key] for one in further for key in inputs_of(one.arguments) if key in plan]
    return next((one.given for one in made if one.stage == "finetune"), {})


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
    for one in _measured(_records_in(home), alone=True):
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
            return last * work / high.work if work > high.work > 0 else min(first, last)
        slope = (last - first) / (high.work - low.work)
        return max(first + slope * (work - low.work), 0.2 * first)

    return StageCost(line(lambda cost: cost.seconds), memory, int(line(lambda cost: cost.disk_bytes)))


def _by_kind(measured: Iterable[Measured]) -> dict[str, list[Measured]]:
    """By kind, by kind without plug-ins, and by stage alone."""
    found: dict[str, list[Measured]] = {}
    for one in measured:
        for name in {one.kind, _without_plugins(one.kind), one.kind.split(" ")[0]}:
            found.setdefault(name, []).append(one)
    return found


def _without_plugins(kind: str) -> str:
    return " ".join(word for word in kind.split(" ") if "/" not in word)


def _records_in(home: Path) -> dict[str, tuple[dict[str, Any], Path]]:
    """Records of stages that were run in a home, and their folders, by key."""
    folders = []
    for stage in (home / "artefacts").glob("*"):
        with contextlib.suppress(OSError):
            newest = sorted(stage.glob(f"*/{RUN_FILE}"), key=lambda path: path.stat().st_mtime, reverse=True)
            folders += [path.parent for path in newest[:MAX_RECORDS]]
    return {folder.name: (record, folder) for folder in folders if (record := _read(folder)) is not None}


def _rows_made(records: Mapping[str, tuple[dict[str, Any], Path]]) -> dict[str, int]:
    return {key: record["rows"] for key, (record, _) in records.items() if record.get("rows") is not None}


def _measured(records: Mapping[str, tuple[dict[str, Any], Path]], *, alone: bool = False) -> list[Measured]:
    """Every stage of the records; `alone`: as fast as if nothing else had used the machine."""
    stages = {
        key: PlannedStage(record["stage"], "", key, cached=True, arguments=record["arguments"])
        for key, (record, _) in records.items()
    }
    amounts = Amounts(stages, _rows_made(records))
    return [
        Measured(
            kind_of(record["stage"], record["arguments"], amounts.image_size(key)),
            amounts.work(key),
            _cost_of(record, folder, alone=alone),
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
