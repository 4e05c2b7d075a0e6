"""The first line of a report says how test data were kept apart, whatever a preset's author believed."""

import pytest

from ctlev_core.report.sections.data_split import told_split


@pytest.mark.parametrize(
    ("splits", "told"),
    [
        (["train+test", "train+test"], "Every tested recording is split in time"),
        (["train", "test", "validation", "condition"], "Tested on whole recordings"),
        (["train+test", "test", "train"], "Of 2 tested recordings 1 are split in time"),
        (["train", "condition"], ""),
    ],
)
def test_what_is_told(splits, told):
    found = told_split(splits)
    assert found.startswith(told) and bool(found) == bool(told)
