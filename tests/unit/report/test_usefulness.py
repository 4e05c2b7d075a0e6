"""Numbers of generators are ranked by how well they rank the generators' gains."""

import numpy as np
import pyarrow as pa
import pytest

from ctlev_core.report.sections.score_tables import PairedScores
from ctlev_core.report.sections.usefulness import usefulness_of, usefulness_overview, usefulness_sections
from data_contracts.training_sets import with_recorded

NAMES = [f"g{number}" for number in range(7)]
METRIC = "mpjpe2d_px"


def experiment(errors, distances, areas, *, names=NAMES):
    """Rows of an experiment in which recorded frames alone give 10 px, with those of each generator so much."""
    random = np.random.default_rng(0)
    noise = random.normal(0, 0.1, 40)
    rows, samples = [], []
    of_sets = {"recorded": 10.0} | {with_recorded(name): error for name, error in zip(names, errors, strict=True)}
    for subject, error in of_sets.items():
        rows.append({"task": "pose2d", "subject": subject, "group": "all", "metric": METRIC, "value": error})
        samples += [
            {
                "subject": subject, "metric": METRIC, "training": 0,
                "sample_id": f"s{row}", "recording_id": f"r{row // 4}",
                "value": error + value, "weight": 1.0, "samples_digest": "d",
            }
            for row, value in enumerate(noise)
        ]  # fmt: skip
    for name, distance in zip(names, distances, strict=True):
        rows.append({"task": "distance", "subject": name, "group": "all", "metric": "fd_event_x", "value": distance})
        agreement = f"label agreement of {name}"
        rows.append({"task": "pose2d", "subject": agreement, "group": "all", "metric": METRIC, "value": distance})
    realism = [
        {"task": "realism", "subject": f"{name} against test", "group": "frames", "metric": "c2st", "value": area}
        for name, area in zip(names, areas, strict=True)
    ]
    columns = {name: [sample[name] for sample in samples] for name in samples[0]}
    return rows, realism, names, PairedScores(pa.table(columns))


def test_what_ranks_as_the_gains_do_is_first_whichever_direction_is_better():
    errors = [9.0, 8.5, 8.0, 7.5, 7.0, 6.5, 6.0]
    found = usefulness_of(*experiment(errors, [70, 60, 50, 40, 30, 20, 10], [0.5, 0.9, 0.6, 0.8, 0.7, 0.55, 1.0]))
    assert found.gains["g0"].added.value == pytest.approx(1.0) and found.gains["g6"].added.value == pytest.approx(4.0)
    names = [(str(one.name), round(one.with_added.value, 2)) for one in found.predictors]
    assert dict(names)["Frechet distance"] == 1 and dict(names)["told apart (C2ST area) from test frames"] < 0
    assert names[-1][0].startswith("told apart")
    assert all(np.isnan(one.with_alone.value) for one in found.predictors), "nothing learnt from synthetic frames alone"
    table, generators, chart = usefulness_sections(found)
    assert table.rows[0][1] == "+1.000 [+0.759, +1.000]" and (0, 1) in table.bold
    assert [row[0] for row in generators.rows][:2] == ["g6", "g5"]
    assert chart.series["generators"][0] == [10, 20, 30, 40, 50, 60, 70]


def test_a_number_that_one_generator_lacks_is_left_out():
    rows, realism, names, paired = experiment([9, 8, 7, 6, 5, 4, 3], range(7), range(7))
    found = usefulness_of(rows, realism[1:], names, paired)
    assert not any("C2ST" in one.name for one in found.predictors)


def test_few_generators_rank_nothing():
    few = NAMES[:5]
    assert usefulness_of(*experiment([9, 8, 7, 6, 5], range(5), range(5), names=few)) is None
    assert usefulness_sections(None) == []


def test_experiments_stand_side_by_side_by_their_mean():
    first = usefulness_of(*experiment([9, 8, 7, 6, 5, 4, 3], [7, 6, 5, 4, 3, 2, 1], [1, 2, 3, 4, 5, 6, 7]))
    second = usefulness_of(*experiment([9, 8, 7, 6, 5, 4, 3], [7, 6, 5, 4, 3, 2, 1], [7, 6, 5, 4, 3, 2, 1]))
    table = usefulness_overview([("pose", first), ("body", second)])
    assert table.columns[-2:] == ["pose", "body"]
    assert table.rows[0][1] == "+1.00" and table.rows[-1][:2] == ["told apart (C2ST area) from test frames", "+0.00"]
