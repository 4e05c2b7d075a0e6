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
        (
            Difference(-0.5, -0.8, -0.2),
            "Adding synthetic frames to the recorded ones helped: 2D joint error (MPJPE) went from 6.000 to 5.500 px, ",
        ),
        (
            Difference(0.5, 0.2, 0.8),
            "Adding synthetic frames to the recorded ones did harm: 2D joint error (MPJPE) went from ",
        ),
        (
            Difference(0.1, -0.2, 0.4),
            "Whether adding synthetic frames to the recorded ones helped is undecided: 2D joint error (MPJPE)",
        ),
        (Difference(0.1, float("nan"), float("nan")), "There are too few test recordings to say whether"),
    ],
)
def test_it_is_the_sentence_that_says_whether_synthetic_data_helped(tmp_path, difference, expected):
    scores = rows(**{"recorded": 6.0, "synthetic": 6.5, "recorded+synthetic": 5.5})
    words = verdict(scores, ["recorded", "synthetic", "recorded+synthetic"], difference)
    table = Table("Scores", ["a"], [["it helped, says the table"]])
    text = render_markdown([table], title="demo", lead="Data: simulated. It helped nobody.", verdict=str(words))
    (tmp_path / "tables.md").write_text(text, encoding="utf-8")
    found = read_verdict(tmp_path)
    assert found.startswith(expected) and found.endswith(".") and "\n" not in found and "6.5" not in found


def test_of_a_study_it_is_the_sentence_of_each_group(tmp_path):
    words = "By 95 % intervals, adding synthetic frames to recorded ones helped in 2 of 2: pose, body.\n\nMore. Words."
    (tmp_path / "tables.md").write_text(render_markdown([], title="demo", lead="Data.", verdict=words))
    assert read_verdict(tmp_path).startswith("By 95 % intervals") and "More" not in read_verdict(tmp_path)


@pytest.mark.parametrize("lead", ["Data.", "", "Data: mine.\n\nOf two paragraphs."])
def test_of_several_experiments_each_has_its_heading(tmp_path, lead):
    words = "\n\n".join(
        f"2D pose ({name}): Less is better. Adding synthetic frames to the recorded ones {what}. More."
        for name, what in (("few 9", "helped: a difference of -0.5"), ("few 12", "changed nothing"))
    )
    (tmp_path / "tables.md").write_text(render_markdown([], title="few", lead=lead, verdict=words))
    assert read_verdict(tmp_path).splitlines() == [
        "2D pose (few 9): Adding synthetic frames to the recorded ones helped: a difference of -0.5.",
        "2D pose (few 12): Adding synthetic frames to the recorded ones changed nothing.",
    ]


def test_without_a_report_there_is_none(tmp_path):
    assert read_verdict(tmp_path) == ""
