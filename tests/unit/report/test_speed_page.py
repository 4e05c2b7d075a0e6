"""Which setting the page recommends, and that it says what it measured."""

import re

import numpy as np
import pytest

from ctlev_core.report.page.html import Curves, render_report
from ctlev_core.report.studies.measurement_charts import CONVERGED_LINE, REFERENCE_LINE
from ctlev_core.report.studies.speed_summary import SUMMARY_FILE, SpeedSummary, read_speed_summary, write_speed_summary
from ctlev_core.report.studies.speed_vs_error import SpeedPage, recommend
from ctlev_core.statistics.sampling_errors import (
    CONTROLNET,
    CONVERGED,
    EXCESS,
    FD,
    HELD_OUT,
    OF_HALVES,
    PIXEL_RMS,
    REFERENCE,
    WALL,
)
from data_contracts.errors import DataError


def row(line, steps, value, metric=FD, against=HELD_OUT, low=None, high=None, study="generator"):
    return {
        "study": study, "line": line, "num_inference_steps": steps, "evaluations": float(steps), "metric": metric,
        "against": against, "value": value, "low": low, "high": high, "num_samples": 96,
    }  # fmt: skip


BAND = row(REFERENCE_LINE, 250, 3.0, low=2.5, high=3.5)


def chosen(rows):
    found = recommend([BAND, row(CONVERGED_LINE, 200, 3.0), *rows])
    return [None if one is None else (one["line"], one["num_inference_steps"]) for one in (found.default, found.quick)]


def test_the_fewest_evaluations_that_stay_within_the_interval_are_recommended():
    rows = [row("a", 30, 3.0), row("a", 10, 3.2), row("a", 20, 3.1), row("a", 5, 9.0), row("b", 15, 2.9)]
    assert chosen(rows) == [("a", 10), ("a", 10)]


def test_a_lucky_point_is_not_recommended():
    """Within the interval at 5, but not at 10: more evaluations cannot be worse."""
    rows = [row("a", 5, 3.4), row("a", 10, 3.8), row("a", 20, 3.1), row("a", 30, 3.2)]
    assert chosen(rows) == [("a", 20), ("a", 5)]


def test_what_is_farther_in_pairs_is_not_recommended():
    rows = [row("a", 10, 3.1), row("a", 20, 3.0), row("a", 10, 0.2, FD + EXCESS, low=0.1, high=0.3)]
    rows.append(row("a", 20, 0.1, FD + EXCESS, low=-0.1, high=0.3))
    assert chosen(rows) == [("a", 20), ("a", 10)]


def test_below_the_interval_is_not_worse():
    assert chosen([row("a", 20, 1.0)]) == [("a", 20), None]


def test_of_equal_numbers_of_evaluations_the_nearer_is_recommended():
    assert chosen([row("a", 8, 3.3), row("b", 8, 3.1)]) == [("b", 8), ("b", 8)]


def test_nothing_is_recommended_where_nothing_stays_or_nothing_is_known():
    assert chosen([row("a", 20, 3.6), row("a", 4, 3.0)]) == [None, None]
    unknown = [row(REFERENCE_LINE, 250, 3.0), row("a", 20, 3.0)]
    assert recommend(unknown).default is None
    assert "nothing can be recommended" in page(unknown).verdict()


def page(rows, own=None):
    pictures = np.zeros((3, 8, 8, 3), np.uint8)
    return SpeedPage(
        rows=rows,
        pictures={(one["line"], one["num_inference_steps"]): pictures for one in rows},
        reference_pictures=pictures,
        condition_pictures=None,
        reference_name="ddpm in 250 steps",
        converged_name="unipc in 200 steps",
        own=own,
        features="classifier, 0123abcd",
    )


ROWS = [
    BAND,
    row(REFERENCE_LINE, 250, 0.5, FD + OF_HALVES, REFERENCE, low=0.4, high=0.6),
    row(REFERENCE_LINE, 250, 2.5, WALL, ""),
    row(REFERENCE_LINE, 250, 250.0, CONTROLNET, ""),
    row("UniPC", 10, 3.2),
    row("UniPC", 5, 8.0),
    row("UniPC", 10, 0.55, FD + OF_HALVES, REFERENCE),
    row("UniPC", 10, 12.0, PIXEL_RMS, CONVERGED),
    row("UniPC", 10, 0.1, WALL, ""),
    row("UniPC", 10, 5.0, CONTROLNET, ""),
]


def test_the_verdict_says_what_was_found():
    text = page(ROWS, own=("UniPC", 5)).verdict()
    assert text.startswith("Recommended: UniPC in 10 evaluations, 25 times fewer than the reference's.")
    assert "the reference, ddpm in 250 steps, has 3 [2.5, 3.5]" in text
    assert "differ from the converged solution by 12 grey levels" in text
    assert "The experiment's own setting, UniPC in 5 evaluations: 8, above the interval." in text
    worse = [*ROWS, row("UniPC", 20, 4.0)]
    assert page(worse).verdict().startswith("No setting stays within the interval")


def test_the_recommendation_is_the_verdict_without_what_is_used_in_a_hurry():
    made = page([*ROWS, row("UniPC", 20, 3.1)], own=("UniPC", 20))
    text = made.recommendation()
    assert text.startswith("Recommended: UniPC in 10 evaluations, 25 times fewer than the reference's.")
    assert text.endswith("The experiment's own setting, UniPC in 20 evaluations: 3.1, within the interval.")
    quick = "Of 5 to 10 evaluations: UniPC in 10 evaluations, 3.2, within the interval. "
    assert made.verdict().replace(quick, "") == text != made.verdict()
    assert "nothing can be recommended" in page([row(REFERENCE_LINE, 250, 3.0)]).recommendation()


def test_it_says_what_so_few_samples_cannot_show():
    """Half the interval of the paired difference, 0.6, is 20 % of the reference's distance."""
    made = page([*ROWS, row("UniPC", 10, 0.2, FD + EXCESS, low=-0.5, high=0.7)])
    assert "With 96 samples, differences below 20% of the distance do not show." in made.recommendation()
    assert "does not show" not in page(ROWS).recommendation()


def test_differences_from_the_solution_are_drawn_with_their_intervals():
    rows = [row("UniPC", 5, 20.0, PIXEL_RMS, CONVERGED, low=19.0, high=22.0), *ROWS]
    (chart,) = page(rows).solution_charts()
    assert chart.series == {"UniPC": ([5.0, 10.0], [20.0, 12.0])}
    np.testing.assert_array_equal(chart.spans["UniPC"], [[19.0, np.nan], [22.0, np.nan]])
    assert page([BAND]).solution_charts() == []


def summary_of(rows):
    made = page(rows)
    return SpeedSummary("pose", made.recommendation(), made.distance_charts(), made.settings())


@pytest.mark.parametrize("rows", [ROWS, ROWS[2:4]], ids=["with charts", "costs alone"])
def test_summaries_come_back_as_they_were(tmp_path, rows):
    summary = summary_of(rows)
    assert len(summary.charts) == (2 if rows is ROWS else 0)
    write_speed_summary(tmp_path, summary)
    back = read_speed_summary(tmp_path)
    assert (back.experiment, back.recommendation) == ("pose", summary.recommendation)
    # As a reader sees them: JSON has lists where the originals have tuples and sets.
    assert rendered(back) == rendered(summary)


def rendered(summary):
    return render_report(title="", lead="", verdict="", sections=[*summary.charts, summary.settings])


@pytest.mark.parametrize("damage", ["", "{}", '{"experiment": "a", "recommendation": "", "charts": []}', "[]"])
def test_damaged_summaries_are_refused(tmp_path, damage):
    (tmp_path / SUMMARY_FILE).write_text(damage)
    with pytest.raises(DataError, match=r"summary\.json: is not the summary of speed against error"):
        read_speed_summary(tmp_path)


def test_charts_have_the_references_interval_and_tables_every_setting():
    made = page(ROWS)
    charts = {section.title: section for section in made.sections() if isinstance(section, Curves)}
    real = charts["Distance to held-out recorded frames"]
    assert list(real.series) == ["UniPC", "ddpm in 250 steps: 95 %"]
    assert real.series["UniPC"] == ([5.0, 10.0], [8.0, 3.2])
    low, high = real.spans["ddpm in 250 steps: 95 %"]
    assert set(low) == {2.5} and set(high) == {3.5}
    across = real.series["ddpm in 250 steps: 95 %"][0]
    assert min(across) == 5 and np.isclose(max(across), 10)
    html = render_report(title="t", lead="", verdict=made.verdict(), sections=made.sections())
    cells = [re.sub("<[^>]+>", "", cell) for cell in re.findall(r"<td[^>]*>(.*?)</td>", html)]
    assert ["UniPC", "10", "5", "100"] in [cells[i : i + 4] for i in range(len(cells))]
    assert "3.2" in cells and "0.55" in cells and "12" in cells
