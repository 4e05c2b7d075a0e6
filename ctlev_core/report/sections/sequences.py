"""The sections of the report on time: do synthetic frames follow one another as recorded ones do?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ctlev_core.realism.stretches import SHUFFLED, labelled_stretches, recorded_stretches
from ctlev_core.realism.two_sample import C2ST
from ctlev_core.report.page.display_names import Name, metric_name, set_name
from ctlev_core.report.page.html import Colours, Films, Section, Table
from ctlev_core.report.sections.two_sample import two_sample_tables
from ctlev_core.statistics.bootstrap import score_text
from data_contracts.labels import HELD_OUT_SPLITS
from data_contracts.manifest import Manifest
from data_contracts.run_record import read_run_record
from data_contracts.tables import TWO_SAMPLE_TESTS
from data_contracts.training_sets import RECORDED

NUM_FILMS = 6
SHOWN_RATE_HZ = 8.0
"""Frames a second: slow enough to see each."""
TITLE = "Sequences: do frames follow one another as recorded ones do?"
_NAMES = {
    RECORDED: Name("recorded training", RECORDED),
    SHUFFLED: Name("the same, time shuffled", SHUFFLED),
    **{split: Name(f"recorded {split}", split) for split in HELD_OUT_SPLITS},
}
_CAPTION = (
    "Stretches of {length} frames, each {step_ms:.3g} ms after the one before. In brackets 95 % intervals under "
    "resampling of recordings. Recorded stretches say what is real; with their frames in shuffled order (labels stay "
    "where they are) they say what a number is worth without any order in time. Activity one (two, four) frames later: "
    "correlation of the number of active pixels within a stretch, 0 without order. Active pixels that stay: with an "
    "active pixel within 1 px in the next frame. Still pixels: far from the skeleton in the whole stretch; active "
    "again, against chance: 1 where noise strikes at random, more where the same pixels fire again. Motion: cosine "
    "between the optical flow of two frames and the labelled motion of joints, 1 = along, -1 = backwards. Polarity: "
    "active pixels whose events, followed along the flow, keep their sign."
)


def sequence_sections(
    measured: Manifest,
    frames: Manifest,
    conditions: Manifest,
    generated: Mapping[str, Manifest],
    colours: Colours = (),
) -> list[Section]:
    """The table of numbers, the two-sample tests of stretches, and films; without stretches to show no films.

    Args:
        measured: what the stage `sequence_realism` made.
        frames: recorded ones.
        conditions: what was asked for.
        generated: frames by generator, the experiment's own first.
        colours: legend of the films.
    """
    arguments = read_run_record(measured.ref.path).arguments
    length, step_us = int(arguments["length"]), int(arguments["step_us"])
    rows, tests = measured.table.to_pylist(), measured.attached(TWO_SAMPLE_TESTS).to_pylist()
    return [
        *_films(frames, conditions, generated, step_us, length, colours),
        numbers_table(rows, length, step_us),
        *two_sample_tables(tests, "stretch", "stretches"),
    ]


def numbers_table(rows: Sequence[dict[str, Any]], length: int, step_us: int) -> Table:
    """Numbers down, sets across.

    Args:
        rows: of the table `scores`, as the stage `sequence_realism` writes them.
        length: frames of a stretch.
        step_us: from a frame to the next.
    """
    found = {(row["subject"], row["metric"]): row for row in rows if row["metric"] != C2ST}
    sets = list(dict.fromkeys(subject for subject, _ in found))
    counts = {subject: row["num_samples"] for (subject, _), row in found.items()}
    body = [
        [metric_name(metric), *(_cell(found.get((subject, metric))) for subject in sets)]
        for metric in dict.fromkeys(metric for _, metric in found)
    ]
    columns = ["number", *(_heading(subject, counts[subject]) for subject in sets)]
    caption = _CAPTION.format(length=length, step_ms=step_us / 1000)
    return Table(TITLE, columns, body, caption=caption, footnotes=["In parentheses: recordings."])


def _heading(subject: str, count: int) -> Name:
    return Name(f"{_NAMES.get(subject, set_name(subject))} ({count})", subject)


def _cell(row: dict[str, Any] | None) -> str | None:
    return None if row is None else score_text(row["value"], row["low"], row["high"])


def _films(
    frames: Manifest,
    conditions: Manifest,
    generated: Mapping[str, Manifest],
    step_us: int,
    length: int,
    colours: Colours,
) -> list[Films]:
    """Stretches of the first generator, evenly spread, beside what was asked for, the others', and recorded ones."""
    found = {name: labelled_stretches(made, frames, step_us, length) for name, made in generated.items()}
    own_name, *_ = generated
    shown = found[own_name].spread(NUM_FILMS)
    if not len(shown):
        return []
    own, recorded = generated[own_name], _Recorded(frames, step_us, length)
    class_names, asked, sources = (own.column(name) for name in ("class_name", "condition_id", "source_id"))
    alike = {name: made.column("source_id") == sources for name, made in generated.items()}
    others = {name: found[name].spread(NUM_FILMS).rows for name, same in alike.items() if not same}
    condition_rows = {name: row for row, name in enumerate(conditions.column("sample_id"))}
    rows = []
    for number, stretch in enumerate(shown.rows):
        class_name = class_names[stretch[0]]
        clips = recorded.clip(class_name, [sources[row] for row in stretch])
        if conditions.has_array("images"):
            of_stretch = np.array([condition_rows[asked[row]] for row in stretch])
            clips.append(("condition", np.asarray(conditions.array("images")[of_stretch])))
        for name, made in generated.items():
            images = made.array("frames")
            if alike[name]:
                clips.append((set_name(name), np.asarray(images[stretch])))
            elif len(others[name]):
                chosen = others[name][number % len(others[name])]
                clips.append((f"{set_name(name)}, asked for other labels", np.asarray(images[chosen])))
        rows.append((class_name.replace("_", " ") or f"example {number + 1}", clips))
    caption = (
        f"Stretches of {length} frames, each {step_us / 1000:.3g} ms after the one before, "
        f"{1e6 / step_us / SHOWN_RATE_HZ:.2g} times slower than they were; evenly spread, none chosen by eye. What is "
        "recorded shows the same moments, or else another person in the same class of motion, where there are such. "
        "The pointer stops a film."
    )
    return [Films("Sequences in motion", rows, SHOWN_RATE_HZ, caption, colours)]


class _Recorded:
    """Recorded stretches to be shown: of each class in turn, held-out ones before those of training."""

    def __init__(self, frames: Manifest, step_us: int, length: int) -> None:
        self._frames, self._shown = frames, {}
        parts = [recorded_stretches(frames, split, step_us, length) for split in (frames.held_out, "train")]
        names = frames.column("class_name")
        self._row_of = {name: row for row, name in enumerate(frames.column("sample_id"))}
        self._by_class: dict[str, list[np.ndarray]] = {}
        for rows in (row for part in parts for row in part.rows):
            self._by_class.setdefault(names[rows[0]], []).append(rows)

    def clip(self, class_name: str, sources: Sequence[str]) -> list[tuple[str, np.ndarray]]:
        """The frames that the labels are of, else the next stretch of a class, else of any; nothing without any."""
        if all(source in self._row_of for source in sources):
            own_rows = np.array([self._row_of[source] for source in sources])
            return [("recorded, same moments", np.asarray(self._frames.array("frames")[own_rows]))]
        same = self._by_class.get(class_name)
        stretches = same or [rows for of_class in self._by_class.values() for rows in of_class]
        if not stretches:
            return []
        number = self._shown[class_name] = self._shown.get(class_name, -1) + 1
        rows = stretches[number % len(stretches)]
        own = self._frames.column("class_name")[rows[0]].replace("_", " ")
        label = "recorded" if same else f"recorded, {own}"
        return [(label, np.asarray(self._frames.array("frames")[rows]))]
