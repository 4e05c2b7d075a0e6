"""What was made from what: the stages behind a report as a picture, and a table of the records of each."""

from __future__ import annotations

from collections.abc import Sequence

from ctlev_core.duration_text import duration_text
from ctlev_core.provenance.records import Record, options_of
from ctlev_core.report.page.display_names import STAGES, role_name, stage_name
from ctlev_core.report.page.html import Box, Diagram
from ctlev_core.report.page.tables import Cell, Table

BOX_WIDTH, BOX_HEIGHT, GAP_X, GAP_Y = 208, 44, 26, 34
_ORDER = {stage: place for place, stage in enumerate(STAGES)}
_CAPTION = (
    "Each box is a stage, with how often it was run and how long that took in all. An arrow leads to what was made "
    "from it, but where a longer way leads there too. Boxes lead to their records."
)


def lineage_diagram(records: Sequence[Record]) -> Diagram:
    """Stages from top to bottom, those that need nothing first."""
    stages = {stage: [one for one in records if one.stage == stage] for stage in _in_order(records)}
    rows = _rows(list(stages), _edges(records))
    places: dict[str, tuple[float, float]] = {}
    width = max(map(len, rows), default=1) * (BOX_WIDTH + GAP_X) - GAP_X
    for depth, row in enumerate(rows):
        left = (width - len(row) * (BOX_WIDTH + GAP_X) + GAP_X) / 2
        for column, stage in enumerate(row):
            places[stage] = left + column * (BOX_WIDTH + GAP_X), depth * (BOX_HEIGHT + GAP_Y)
    boxes = [
        Box(*places[stage], stage_name(stage), _told(runs), f"#{_anchor(stage)}") for stage, runs in stages.items()
    ]
    arrows = [(places[above], places[below]) for above, below in _without_shortcuts(_edges(records))]
    paths = [_arrow(*ends) for ends in arrows if ends[0][1] < ends[1][1]]
    height = len(rows) * (BOX_HEIGHT + GAP_Y) - GAP_Y
    return Diagram("What was made from what", boxes, paths, (width, height), (BOX_WIDTH, BOX_HEIGHT), _CAPTION)


def record_tables(records: Sequence[Record]) -> list[Table]:
    """The options of every stage as they were, defaults included, a table a stage."""
    found = []
    for stage in _in_order(records):
        body: list[list[Cell]] = [
            [
                role_name(record.role), record.rows, record.started.replace("T", " ").removesuffix("Z"),
                round(record.wall_seconds, 1), f"`{record.key[:12]}`", f"`{record.digest[:12]}`", _options(record),
            ]
            for record in records
            if record.stage == stage
        ]  # fmt: skip
        columns = ["what", "rows", "started, UTC", "seconds", "key", "digest", "options"]
        caption = f"In the folder `artefacts/{stage}` of the home, under the key of each."
        found.append(Table(stage_name(stage), columns, body, caption=caption, anchor=_anchor(stage)))
    return found


def _options(record: Record) -> str:
    options = options_of(record).items()
    return " ".join(f"`{name.replace('.options.', '.')}={value}`" for name, value in options)


def _anchor(stage: str) -> str:
    return f"record-{stage}"


def _in_order(records: Sequence[Record]) -> list[str]:
    """The stages in the order of a run; those that are not known last."""
    return sorted(dict.fromkeys(record.stage for record in records), key=lambda stage: _ORDER.get(stage, len(_ORDER)))


def _edges(records: Sequence[Record]) -> list[tuple[str, str]]:
    """(stage, stage made from it), each once, from earlier to later ones: models choose frames for other models."""
    stage_of = {record.key: record.stage for record in records}
    order = {stage: place for place, stage in enumerate(_in_order(records))}
    pairs = {(stage_of[key], record.stage) for record in records for key in record.upstream if key in stage_of}
    return sorted(
        (pair for pair in pairs if order[pair[0]] < order[pair[1]]), key=lambda pair: [order[s] for s in pair]
    )


def _rows(stages: list[str], edges: list[tuple[str, str]]) -> list[list[str]]:
    """Stages by the length of the longest way to them."""
    depth = dict.fromkeys(stages, 0)
    for above, below in edges:  # by order of the first, which is final before it is used
        depth[below] = max(depth[below], depth[above] + 1)
    return [[stage for stage in stages if depth[stage] == row] for row in range(max(depth.values(), default=-1) + 1)]


def _without_shortcuts(edges: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """The edges without those that a longer way replaces."""
    below: dict[str, set[str]] = {}
    for above, other in reversed(edges):
        below.setdefault(above, set()).update({other}, below.get(other, set()))
    return [
        (a, b) for a, b in edges if not any(b in below.get(c, set()) for other, c in edges if other == a and c != b)
    ]


def _told(runs: Sequence[Record]) -> str:
    times = f"{len(runs)} × · " if len(runs) > 1 else ""
    seconds = sum(record.wall_seconds for record in runs)
    return f"{times}{duration_text(seconds) if seconds >= 9.95 else f'{seconds:.1f} s'}"


def _arrow(start: tuple[float, float], end: tuple[float, float]) -> str:
    x0, y0, x1, y1 = start[0] + BOX_WIDTH / 2, start[1] + BOX_HEIGHT, end[0] + BOX_WIDTH / 2, end[1] - 6
    middle = (y0 + y1) / 2
    return f"M{x0:g} {y0:g}C{x0:g} {middle:g} {x1:g} {middle:g} {x1:g} {y1:g}"
