"""The one sentence that a run ends with, from the tables of its report."""

from __future__ import annotations

import pytest

from ctlev_core.report.page.report_files import read_verdict
from ctlev_core.report.page.tables import Table, render_markdown
from ctlev_core.report.sections.verdict import verdict
from ctlev_core.statistics.paired_differences import Difference


def rows(**values: float) -> list[dict]:
    return [
        {"subject": subject, "group": "all", "metric": "mpjpe2d_px", "value": value}
        for subject, value in values.items()
    ]


@pytest.mark.parametrize(
    ("difference", "expected"),
    [
        (Difference(-0.5, -0.8, -0.2), "Adding synthetic data made it better: paired difference "),
        (Difference(0.5, 0.2, 0.8), "Adding synthetic data made it worse: paired difference "),
        (Difference(0.1, -0.2, 0.4), "Whether adding synthetic data helped is undecided: paired difference "),
        (Difference(0.1, float("nan"), float("nan")), "There are too few test recordings to say whether"),
    ],
)
def test_it_is_the_sentence_that_says_whether_synthetic_data_helped(tmp_path, difference, expected):
    scores = rows(**{"recorded": 6.0, "synthetic": 6.5, "recorded+synthetic": 5.5})
    words = verdict(scores, ["recorded", "synthetic", "recorded+synthetic"], difference)
    table = Table("Scores", ["a"], [["it helped, says the table"]])
    text = render_markdown([table], title="demo", lead="Data: simulated. It helped nobody.", verdict=words)
    (tmp_path / "tables.md").write_text(text, encoding="utf-8")
    found = read_verdict(tmp_path)
    assert found.startswith(expected) and found.endswith(".") and "\n" not in found and "6.5" not in found


def test_of_a_study_it_is_the_sentence_of_each_group(tmp_path):
    words = "By 95 % intervals, adding synthetic frames to recorded ones helped in 2 of 2: pose, body.\n\nMore. Words."
    (tmp_path / "tables.md").write_text(render_markdown([], title="demo", lead="Data.", verdict=words))
    assert read_verdict(tmp_path).startswith("By 95 % intervals") and "More" not in read_verdict(tmp_path)


def test_of_several_experiments_each_has_its_heading(tmp_path):
    words = "\n\n".join(
        f"2D pose (`{name}`): mpjpe2d_px (lower is better): recorded 6, both 5.5. Adding synthetic data {what}. More."
        for name, what in (("few_9", "made it better: paired difference -0.5"), ("few_12", "changed nothing"))
    )
    (tmp_path / "tables.md").write_text(render_markdown([], title="few", lead="Data.", verdict=words))
    assert read_verdict(tmp_path).splitlines() == [
        "2D pose (`few_9`): Adding synthetic data made it better: paired difference -0.5.",
        "2D pose (`few_12`): Adding synthetic data changed nothing.",
    ]


def test_without_a_report_there_is_none(tmp_path):
    assert read_verdict(tmp_path) == ""
