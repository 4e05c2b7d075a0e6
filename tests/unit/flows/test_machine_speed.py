"""A slower machine than that of `stage_costs.json`: what has finished says so of what has not."""

import pytest

from flows import stage_costs
from flows.stage_costs import Measured, StageCost, predict_stages
from tasks.stage import PlannedStage


def planned(stage, key, rows):
    return PlannedStage(stage, key, key, cached=False, arguments={"num_train_recordings": rows})


@pytest.fixture
def table(monkeypatch):
    """Two kinds of stages, of which 10 rows take 5 s and 20 s, and one too short to tell."""
    measured = [Measured(name, 10.0, StageCost(seconds, 500.0, 9)) for name, seconds in TABLE.items()]
    monkeypatch.setattr(stage_costs, "_reference", lambda: measured)


TABLE = {"ingest": 5.0, "encode": 20.0, "contact_sheet": 0.1}
STAGES = [PlannedStage("encode", "encode", "e", cached=False, arguments={})]


def seconds(known):
    found = predict_stages([planned("ingest", "i", 10), *STAGES], known)
    return {key: cost.seconds for key, cost in found.items()}


def ran(name, took, work=10.0):
    return Measured(name, work, StageCost(took, 500.0, 9, is_known=True))


def test_nothing_ran_and_nothing_is_scaled(table):
    alone = seconds([])
    assert alone["i"] == 5.0
    assert seconds([ran("contact_sheet", 5.0), ran("unheard_of", 500.0)]) == alone


def test_what_took_three_times_as_long_makes_the_rest_so(table):
    alone, slow = seconds([]), seconds([ran("ingest", 15.0), ran("ingest", 15.0)])
    assert slow["i"] == 15.0, "as measured, not scaled"
    assert slow["e"] == pytest.approx(3 * alone["e"])
    assert seconds([ran("ingest", 2.5)])["e"] == pytest.approx(0.5 * alone["e"])


def test_kinds_count_once_however_often_they_ran(table):
    alone = seconds([])
    known = [*[ran("ingest", 10.0)] * 9, ran("contact_sheet", 0.9)]
    assert seconds(known)["e"] == pytest.approx(2 * alone["e"])
