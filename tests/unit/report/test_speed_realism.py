"""How real sampled frames look, on the page on speed and error."""

from __future__ import annotations

import numpy as np
import pytest

from ctlev_core.realism.sampling import realism_of_real, realism_of_samples
from ctlev_core.realism.two_sample import MIN_FRAMES
from ctlev_core.report.page.html import render_report
from ctlev_core.report.studies.measurement_charts import REFERENCE_LINE
from ctlev_core.report.studies.speed_realism import realism_table
from ctlev_core.statistics.sampling_errors import HELD_OUT


def pictures(count: int, isolated: bool, seed: int) -> np.ndarray:
    """A block of 2 x 2 pixels and, perhaps, an isolated one far from it."""
    rng = np.random.default_rng(seed)
    frames = np.zeros((count, 12, 12, 3), np.uint8)
    for frame in frames:
        row, column = rng.integers(0, 4, 2)
        frame[row : row + 2, column : column + 2] = 200
        if isolated:
            frame[11, rng.integers(12)] = 200
    return frames


def names(count: int) -> list[str]:
    return [f"r{number}" for number in range(count)]


def test_isolated_pixels_are_counted_and_told():
    count = MIN_FRAMES
    found = realism_of_samples(pictures(count, True, 0), names(count), pictures(count, False, 1), names(count))
    by_name = {(one.metric, one.against): one for one in found}
    told = by_name["c2st", HELD_OUT]
    assert told.value > 0.95 and told.low <= told.value <= told.high
    assert by_name["active_pixel_share", ""].value == pytest.approx(5 / 144)
    assert by_name["isolated_pixel_share", ""].value == pytest.approx(1 / 5)
    real = {(one.metric, one.against): one for one in realism_of_real(pictures(count, False, 1), names(count))}
    assert real["isolated_pixel_share", HELD_OUT].value == 0
    assert ("c2st_halves", HELD_OUT) not in real, "halves of so few are too small"


def test_of_too_few_frames_nothing_is_said():
    few = pictures(MIN_FRAMES - 1, True, 0)
    assert realism_of_samples(few, names(len(few)), few, names(len(few))) == []
    assert realism_of_real(few, names(len(few))) == []


def row(line, metric, value, against="", low=None, high=None, steps=5):
    return {
        "study": "generator", "line": line, "num_inference_steps": steps, "evaluations": float(steps), "metric": metric,
        "against": against, "value": value, "low": low, "high": high, "num_samples": 96,
    }  # fmt: skip


def test_every_setting_has_a_row_and_what_is_missing_is_told():
    rows = [
        row(REFERENCE_LINE, "c2st_halves", 0.5, HELD_OUT, 0.4, 0.6, steps=250),
        row(REFERENCE_LINE, "active_pixel_share", 0.1, HELD_OUT, steps=250),
        row(REFERENCE_LINE, "c2st", 0.75, HELD_OUT, 0.625, 0.875, steps=250),
        row(REFERENCE_LINE, "active_pixel_share", 0.125, steps=250),
        row("UniPC", "wall_seconds", 1.0),
    ]
    table = realism_table(rows, lambda line: line.upper())
    assert table.rows == [
        ["held-out recorded frames; area: their halves", None, "0.500 [0.400, 0.600]", "0.100", None],
        ["REFERENCE", "250", "0.750 [0.625, 0.875]", "0.125", None],
        ["UNIPC", "5", None, None, None],
    ]
    assert "fewer than 40 frames" in table.footnotes[0]
    assert "fewer than 40 frames" in render_report(title="t", lead="", verdict="", sections=[table])
