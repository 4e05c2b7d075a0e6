"""The recordings of a report, and how training and test data were kept apart, told from the recordings themselves."""

from __future__ import annotations

from collections.abc import Sequence

from ctlev_core.report.page.tables import Cell, Table
from data_contracts.manifest import Manifest


def told_split(splits: Sequence[str], held_out: str) -> str:
    """A sentence for the first line of a report.

    Args:
        splits: of each recording, the splits its parts belong to, joined by +.
        held_out: the split that is scored.
    """
    parts = [set(each.split("+")) for each in splits]
    tested = [part for part in parts if held_out in part]
    shared = sum("train" in part for part in tested)
    if not tested:
        return ""
    if not shared:
        return "Tested on whole recordings, of which nothing was learnt."
    if shared == len(tested):
        return (
            "Every tested recording is split in time: learnt from one part, tested on another. Scores say how well "
            "windows of the same recordings are told apart, not how well unseen recordings would be."
        )
    return f"Of {len(tested)} tested recordings {shared} are split in time, and also learnt from."


def told_openings(held_out: str, openings: int | None) -> str:
    """A sentence on how often what is scored was looked at before."""
    if held_out == "validation":
        return "Scored on validation recordings; nothing of the test recordings was looked at."
    if openings is None:
        return ""
    if openings == 1:
        return "This is the first experiment in this store to be scored on these test frames."
    return (
        f"It is one of {openings} experiments in this store, of other options or seeds, that were scored on these test "
        "frames; a best of several, chosen by test scores, is better there than elsewhere."
    )


def recordings_table(recordings: Manifest, frames: Manifest) -> Table:
    """Recordings added up by split and class, with their events."""
    table = recordings.table.to_pylist()
    frames_of: dict[str, int] = {}
    for name in frames.column("recording_id"):
        frames_of[name] = frames_of.get(name, 0) + 1
    body: list[list[Cell]] = []
    for key in dict.fromkeys((row["splits"], row["class_name"]) for row in table):
        members = [row for row in table if (row["splits"], row["class_name"]) == key]
        body.append(
            [
                *key,
                len(members),
                len({row["subject"] for row in members}),
                sum(row["num_events"] for row in members),
                sum(row["num_positive"] for row in members),
                sum(row["num_negative"] for row in members),
                round(sum(row["duration_us"] for row in members) / 1e6, 4),
                sum(frames_of.get(row["recording_id"], 0) for row in members),
            ]
        )
    columns = ["split", "class", "recordings", "subjects", "events", "ON", "OFF", "seconds", "frames"]
    return Table("Recordings", columns, body, caption="Splits are fixed at ingest. `condition`: labels without events.")
