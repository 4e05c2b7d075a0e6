"""The table of the report that says how many frames and features a distance is of, and its floor."""

from __future__ import annotations

import numpy as np

from ctlev_core.metrics import frechet
from ctlev_core.report.sections.distances import floor_tables
from ctlev_core.statistics.feature_distances import DISTANCE_ESTIMATES, estimate_distances, estimates_table


class Scores:
    """A manifest of scores with, or without, estimates beside them."""

    def __init__(self, table=None):
        self.table = table
        self.files = () if table is None else (f"{DISTANCE_ESTIMATES.name}.parquet",)

    def attached(self, schema):
        assert schema is DISTANCE_ESTIMATES
        return self.table


def estimated(training_set, rows, groups, options=None):
    random = np.random.default_rng(rows)
    real, made = random.normal(size=(40, 3)), random.normal(0.5, 1, size=(rows, 3))

    def compute(predicted, target):
        return frechet.compute(predicted, target, options or frechet.Options())

    found = estimate_distances(compute, made, real, predicted_groups=groups, target_groups=np.arange(40) // 2)
    return Scores(estimates_table(training_set, found)), next(iter(found.values()))


def test_distances_stand_beside_their_floor_and_the_numbers_they_depend_on():
    (many, estimate), (few, alone) = estimated("many", 30, np.arange(30) // 2), estimated("few", 30, np.zeros(30))
    (table,) = floor_tables([Scores(), many, few])
    assert len(set(table.columns)) == len(table.columns) == len(table.rows[0])
    floor = f"{estimate.floor:.3f} [{estimate.floor_low:.3f}, {estimate.floor_high:.3f}]"
    halved = f"{estimate.halved:.3f}"
    assert table.rows[0] == ["many", "Frechet distance", f"{estimate.value:.3f}", halved, floor, 30, 40, 3]
    # One recording cannot be halved.
    assert table.rows[1] == ["few", "Frechet distance", f"{alone.value:.3f}", None, None, 30, 40, 3]
    assert floor_tables([Scores()]) == []


def test_halves_of_recorded_frames_are_no_floor_of_a_distance_to_published_statistics(tmp_path):
    """The file is far from both sets: halves of the recorded frames are as far from it as all of them."""
    np.savez(tmp_path / "published.npz", mu=np.full(3, 50.0), sigma=np.eye(3))
    options = frechet.Options(statistics=str(tmp_path / "published.npz"))
    own, estimate = estimated("own", 30, np.arange(30) // 2, options)
    assert estimate.floor > 7000
    other, _ = estimated("other", 30, np.arange(30) // 2)
    (table,), (usual,) = floor_tables([own]), floor_tables([other])
    assert "it is what recorded frames score, and no floor" in str(table.caption)
    assert "no floor" not in str(usual.caption)
