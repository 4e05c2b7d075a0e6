"""The first line of a report says how test data were kept apart, whatever a preset's author believed."""

import pytest

from ctlev_core.report.sections.data_split import told_openings, told_split


@pytest.mark.parametrize(
    ("splits", "held_out", "told"),
    [
        (["train+test", "train+test"], "test", "Every tested recording is split in time"),
        (["train", "test", "validation", "condition"], "test", "Tested on whole recordings"),
        (["train+test", "test", "train"], "test", "Of 2 tested recordings 1 are split in time"),
        (["train+test", "validation", "train"], "validation", "Tested on whole recordings"),
        (["train", "condition"], "test", ""),
    ],
)
def test_what_is_told(splits, held_out, told):
    found = told_split(splits, held_out)
    assert found.startswith(told) and bool(found) == bool(told)


def test_how_often_test_frames_were_scored_is_told():
    assert told_openings("test", None) == ""
    assert "the first experiment" in told_openings("test", 1)
    assert "one of 7 experiments" in told_openings("test", 7)
    assert "nothing of the test recordings" in told_openings("validation", None)
