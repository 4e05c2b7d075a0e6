"""What differs between two finished experiments: options, data, code and scores.

Both are read from the folders of their reports, wherever those were copied to. Stages are matched by what they are in
the experiment (`checkpoint of synthetic`, `model of recorded, seed 0`). Scores are compared sample by sample where both
were measured on the very same samples, images and labels; elsewhere recordings are drawn for each on its own, and where
no scores of samples were kept the intervals of both are joined: Zou & Donner, Construction of Confidence Limits about
Effect Measures, Statistics in Medicine 2008.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from ctlev_core.provenance.records import Record, options_of, read_provenance, versions_of
from ctlev_core.provenance.scores import PAIRED_SAMPLES, SCORE_LINEAGE
from ctlev_core.report.page.display_names import metric_heading, role_name, subject_name
from ctlev_core.report.page.tables import Cell, Table
from ctlev_core.report.sections.score_tables import cell_text, interval_over_trainings
from ctlev_core.statistics.paired_differences import (
    Difference,
    Trainings,
    paired_difference,
    read_trainings,
    unpaired_difference,
)
from data_contracts.errors import DataError
from data_contracts.tables import TableSchema, check_table
from data_contracts.training_sets import LabelAgreement

DATA_STAGES = ("ingest", "encode", "condition_frames", "condition_samples", "sample", "simulate", "finetune")
_ABSENT = "(none)"


@dataclass(frozen=True, eq=False)
class Run:
    """A finished experiment.

    Attributes:
        name: as asked for.
        records: of all its stages.
        scores: rows of the table `score_lineage`.
        trainings: scores of single samples by subject and score.
    """

    name: str
    records: list[Record]
    scores: list[dict[str, Any]]
    trainings: dict[tuple[str, str], Trainings]


def find_run(name: str, home: Path) -> Path:
    """The folder with the tables of a run's report.

    Args:
        name: of a report in the home; the first digits of the key of a report's artefact, six or more; or the path of a
            report, of its folder, or of a file in it.
        home: folder of all state.
    Raises:
        DataError: there is no such run, or more than one.
    """
    path = Path(name)
    if path.suffix == ".html" and path.is_file():
        return path.with_suffix("")
    for folder in (path, path.parent, home / "reports" / name):
        if (folder / "provenance.json").is_file() and (folder != path.parent or path.is_file()):
            return folder
    keys = []
    if re.fullmatch(r"[0-9a-f]{6,32}", name):
        keys = [folder for folder in (home / "artefacts" / "report").glob(f"{name}*") if folder.is_dir()]
    if len(keys) == 1:
        return keys[0]
    if keys:
        raise DataError(f"run {name!r}: {len(keys)} reports have keys that start so; give more digits")
    raise DataError(
        f"run {name!r}: is neither the path of a report nor one of {home}, which has {_known(home)}; reports of "
        "earlier versions, without provenance.json, must be made again"
    )


def _known(home: Path) -> str:
    reports = home / "reports"
    names = sorted(str(path.parent.relative_to(reports)) for path in reports.rglob("provenance.json"))
    keys = sorted(path.name[:12] for path in (home / "artefacts" / "report").glob("*") if path.is_dir())
    return f"reports {', '.join(names) or '(none)'} and keys {', '.join(keys) or '(none)'}"


def read_run(name: str, folder: Path) -> Run:
    """Read the folder that a report's tables lie in.

    Raises:
        DataError: a file of it is missing, or is of another version.
    """
    if not (folder / "provenance.json").is_file():
        raise DataError(f"{folder}: holds no provenance.json; a report of an earlier version must be made again")
    records = read_provenance(folder / "provenance.json")
    scores = _read(folder / "scores.parquet", SCORE_LINEAGE)
    samples = _read(folder / "samples.parquet", PAIRED_SAMPLES)
    return Run(name, records, scores.to_pylist(), read_trainings(samples))


def _read(path: Path, schema: TableSchema) -> pa.Table:
    try:
        return check_table(pq.read_table(path).replace_schema_metadata(None), schema, str(path))
    except (OSError, pa.ArrowInvalid) as error:
        raise DataError(f"{path}: is not a table of a report: {error}; make the report again") from error


def compare_runs(first: Run, second: Run) -> list[Table]:
    """Tables of the differences, scores first; every difference is second minus first."""
    return [
        _scores_table(first, second),
        _options_table(first, second),
        _data_table(first, second),
        _versions_table(first, second),
    ]


def _scores_table(first: Run, second: Run) -> Table:
    found = [_by_score(run.scores) for run in (first, second)]
    body: list[list[Cell]] = []
    bold: set[tuple[int, int]] = set()
    for key in dict.fromkeys([*found[0], *found[1]]):
        rows = [of_run.get(key, []) for of_run in found]
        subject, metric = key
        row: list[Cell] = [
            subject_name(subject) if LabelAgreement.parse(subject) is None else f"labels of {subject_name(subject)}",
            metric_heading(metric),
            *map(cell_text, rows),
            "",
            "",
        ]
        if all(rows):
            difference, how = _difference(key, first, second, rows)
            row[-2:] = [difference.text(), how]
            if difference.is_certain:
                bold.add((len(body), 4))
        body.append(row)
    caption = (
        f"Means over trainings with 95 % intervals, and {second.name} minus {first.name}. Paired: sample by sample on "
        "the same test samples, which sees small differences; separate: other test samples, or other frames; "
        "intervals: joined from those of both. Bold: the interval excludes 0."
    )
    columns = ["subject", "score", first.name, second.name, "difference", "compared"]
    return Table("Scores", columns, body, caption=caption, bold=bold)


def _by_score(rows: Iterable[dict[str, Any]]) -> dict[tuple[str, str], list[dict[str, Any]]]:
    found: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        if row["group"] == "all":
            found.setdefault((row["subject"], row["metric"]), []).append(row)
    return found


def _difference(
    key: tuple[str, str], first: Run, second: Run, rows: list[list[dict[str, Any]]]
) -> tuple[Difference, str]:
    before, after = first.trainings.get(key), second.trainings.get(key)
    if before is not None and after is not None:
        if before.scores_the_same_as(after):
            return paired_difference(before, after), "paired"
        return unpaired_difference(before, after), "separate"
    (value, low, high), (other, other_low, other_high) = (interval_over_trainings(of_run) for of_run in rows)
    change = other - value
    below, above = math.hypot(other - other_low, high - value), math.hypot(other_high - other, value - low)
    return Difference(change, change - below, change + above), "intervals"


def _options_table(first: Run, second: Run) -> Table:
    """Options that differ; one that many stages share is one row."""
    records = [{record.role: record for record in run.records} for run in (first, second)]
    found: dict[tuple[str, str, str], list[str]] = {}
    for role in dict.fromkeys([*records[0], *records[1]]):
        pair = [of_run.get(role) for of_run in records]
        if pair[0] is None or pair[1] is None:
            before, after = (_ABSENT if record is None else "run" for record in pair)
            found.setdefault(("the stage itself", before, after), []).append(role)
            continue
        options = [options_of(record) for record in pair if record is not None]
        for name in dict.fromkeys([*options[0], *options[1]]):
            before, after = (str(of_role.get(name, _ABSENT)) for of_role in options)
            if before != after:
                found.setdefault((name, before, after), []).append(role)
    body: list[list[Cell]] = [[f"`{name}`", a, b, _where(roles)] for (name, a, b), roles in found.items()]
    caption = "Every option in which a stage of one differs from the same stage of the other, defaults included."
    return Table("Options", ["option", first.name, second.name, "of"], body, caption=caption if body else "No option.")


def _where(roles: list[str]) -> str:
    return role_name(roles[0]) if len(roles) == 1 else f"{role_name(roles[0])}, and {len(roles) - 1} more"


def _data_table(first: Run, second: Run) -> Table:
    """Recordings, frames, conditions and generators whose content differs, and why it can."""
    records = [{record.role: record for record in run.records} for run in (first, second)]
    body: list[list[Cell]] = []
    same = 0
    for role, record in records[0].items():
        other = records[1].get(role)
        if other is None or record.stage not in DATA_STAGES:
            continue
        if record.digest == other.digest:
            same += 1
            continue
        body.append(
            [role_name(role), record.rows, other.rows, record.digest[:12], other.digest[:12], _cause(record, other)]
        )
    caption = f"Sets of data and generators whose content differs; {same} more are equal, bit for bit."
    columns = ["what", f"rows, {first.name}", f"rows, {second.name}", f"digest, {first.name}", f"digest, {second.name}"]
    return Table("Data", [*columns, "because of"], body, caption=caption)


def _cause(first: Record, second: Record) -> str:
    """The nearest thing behind a difference in content."""
    if first.key == second.key:
        return "nothing: options, code and inputs are the same, so another machine or run gave other numbers"
    causes = []
    if options_of(first) != options_of(second):
        causes.append("options")
    if versions_of([first]) != versions_of([second]):
        causes.append("versions")
    if sorted(first.upstream.values()) != sorted(second.upstream.values()):
        causes.append("inputs")
    return ", ".join(causes) or "raw files (recordings, or the base model's)"


def _versions_table(first: Run, second: Run) -> Table:
    versions = [versions_of(run.records) for run in (first, second)]
    names = sorted({*versions[0], *versions[1]})
    pairs = [(name, *(of_run.get(name, _ABSENT) for of_run in versions)) for name in names]
    body: list[list[Cell]] = [list(pair) for pair in pairs if pair[1] != pair[2]]
    same = len(names) - len(body)
    caption = f"Versions of stages, plug-ins, software and machine that differ; {same} more are equal."
    return Table("Code", ["what", first.name, second.name], body, caption=caption)
