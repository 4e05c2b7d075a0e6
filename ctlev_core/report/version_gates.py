"""Is a new version of synthetic data good enough to take the place of the one before?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ctlev_core.realism.distances import FRAME_DISTANCES
from ctlev_core.realism.two_sample import C2ST, MIN_FRAMES
from ctlev_core.scoring.score_info import lower_is_better
from data_contracts.errors import DataError
from data_contracts.labels import HELD_OUT_SPLITS
from data_contracts.published import GateCheck
from data_contracts.regeneration import Gates
from data_contracts.training_sets import HELD_OUT, RECORDED, SYNTHETIC


def check_asked(gates: Gates, num_frames: int) -> None:
    """Raise `DataError` where a version of so many frames can never have the score that a gate judges."""
    for name in gates.max_realism_distances or {}:
        if name not in FRAME_DISTANCES:
            raise DataError(f"gates.max_realism_distances: no distance {name!r}; known: {', '.join(FRAME_DISTANCES)}")
    if gates.max_c2st is not None and num_frames < MIN_FRAMES:
        raise DataError(f"gates.max_c2st: needs num_synthetic of {MIN_FRAMES} or more, got {num_frames}")


def check_gates(
    gates: Gates, scores: Sequence[dict[str, Any]], *, task: str, labels_of: str, rejected_share: float
) -> list[GateCheck]:
    """Every gate that is asked for, with the number it judges.

    Args:
        gates: thresholds; those that are None are left out.
        scores: rows of the table `scores`: distances of `HELD_OUT` and `SYNTHETIC` frames, of equally many; scores of
            the model trained on recorded frames, subject `RECORDED`, and of that model on the version's frames; copies;
            realism.
        task: of that model; its first score decides.
        labels_of: subject of its scores on the version's frames.
        rejected_share: of frames that are no event images.
    Raises:
        DataError: a score that a gate needs is missing.
    """
    checks: list[GateCheck] = []
    if gates.max_distance_ratio is not None:
        floor, value = (_find(scores, "distance", subject, ("fd_event_", "fid")) for subject in (HELD_OUT, SYNTHETIC))
        score = "Frechet distance to the recorded training frames"
        checks.append(_check("max_distance_ratio", score, value["value"], gates.max_distance_ratio * floor["value"]))
    if gates.max_label_error_ratio is not None:
        floor, value = (_find(scores, task, subject) for subject in (RECORDED, labels_of))
        score = f"error of labels, {value['metric']}"
        checks.append(
            _check("max_label_error_ratio", score, _error(value), gates.max_label_error_ratio * _error(floor))
        )
    if gates.max_memorised_share is not None:
        copies = [row for row in scores if row["task"] == "memorisation" and row["subject"] != HELD_OUT]
        shares = [row["value"] for row in copies if row["metric"] == "close_share"]
        if not shares:
            raise DataError("gate max_memorised_share: nothing was searched for copies")
        # Where many recorded frames are alike the threshold of `close_share` is 0, which no distance is below.
        shares += [row["value"] / row["num_samples"] for row in copies if row["metric"] == "duplicates"]
        checks.append(_check("max_memorised_share", "share of copies", max(shares), gates.max_memorised_share))
    if gates.max_rejected_share is not None:
        score = "share of frames that are no event images"
        checks.append(_check("max_rejected_share", score, rejected_share, gates.max_rejected_share))
    return checks + _check_realism(gates, scores)


def _check_realism(gates: Gates, scores: Sequence[dict[str, Any]]) -> list[GateCheck]:
    """Gates of the task `realism`."""
    found = {(row["subject"], row["metric"]): row["value"] for row in scores if row["task"] == "realism"}
    checks: list[GateCheck] = []
    if gates.max_c2st is not None:
        values = [found.get((f"{SYNTHETIC} against {split}", C2ST)) for split in HELD_OUT_SPLITS]
        value = next((area for area in values if area is not None), None)
        if value is None:
            raise DataError(
                f"gate max_c2st: needs {MIN_FRAMES} frames of the version and as many held-out recorded ones, of "
                "several recordings"
            )
        score = "area under the ROC curve, told from held-out recorded frames"
        checks.append(_check("max_c2st", score, value, gates.max_c2st))
    known = {name: value for (subject, name), value in found.items() if subject == f"{SYNTHETIC} against recorded"}
    for name, limit in (gates.max_realism_distances or {}).items():
        if name not in known:
            raise DataError(f"gate max_realism_distances: expected names of {', '.join(sorted(known))}; got {name!r}")
        checks.append(_check("max_realism_distances", f"{name} against recorded", known[name], limit))
    return checks


def _check(gate: str, score: str, value: float, limit: float) -> GateCheck:
    return GateCheck(gate=gate, score=score, value=float(value), limit=float(limit))


def _find(
    scores: Sequence[dict[str, Any]], task: str, subject: str, metric: str | tuple[str, ...] = ""
) -> dict[str, Any]:
    """The first score of a task and subject, of all data, whose name starts so."""
    for row in scores:
        if (row["task"], row["subject"], row["group"]) == (task, subject, "all") and row["metric"].startswith(metric):
            return row
    raise DataError(f"gates: {task!r} has no score {metric!r} of subject {subject!r}")


def _error(row: dict[str, Any]) -> float:
    """Shares that want to be large become the share that is missing."""
    return row["value"] if lower_is_better(row["metric"]) else 1 - row["value"]
