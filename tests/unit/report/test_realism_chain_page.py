"""The page on where realism is lost: what it says of given measurements."""

from __future__ import annotations

import numpy as np
import pytest

from ctlev_core.report.page.html import Folded, ImageGrid, Table, render_report
from ctlev_core.report.studies.realism_chain import GRID_COLUMNS, ChainPage

KEYS = [("recorded", 0), ("autoencoder", 0), ("values", 0), ("denoised", 20), ("denoised", 400), ("sampled", 12)]
AREAS = {
    ("recorded", 0): (0.52, 0.45, 0.58), ("autoencoder", 0): (0.5, 0.5, 0.5), ("values", 0): (0.55, 0.48, 0.6),
    ("denoised", 20): (0.9, 0.86, 0.94), ("denoised", 400): (0.93, 0.9, 0.95), ("sampled", 12): (0.99, 0.98, 1.0),
}  # fmt: skip


def row(key, metric, value, span=(None, None), difference=(None, None, None), note=""):
    return {
        "link": key[0], "amount": key[1], "evaluations": key[1], "metric": metric, "value": value, "low": span[0],
        "high": span[1], "difference": difference[0], "difference_low": difference[1],
        "difference_high": difference[2], "num_samples": 80, "note": note,
    }  # fmt: skip


def page(areas, differences=(), note=""):
    rows = [row(key, "c2st", value, span, note=note) for key, (value, *span) in areas.items()]
    rows += [row(key, "isolated_pixel_share", 0.2, (0.1, 0.3), difference) for key, difference in differences]
    pictures = {key: np.full((20, 4, 4, 3), number, np.uint8) for number, key in enumerate(areas)}
    return ChainPage(rows, pictures)


def test_the_verdict_names_the_first_row_that_is_told_and_the_largest_rise():
    assert page(AREAS).verdict() == (
        "Told from recorded frames first: denoised from t = 20, area 0.900 [0.860, 0.940]. "
        "The area rises most from values as in sampling (0.55) to denoised from t = 20 (0.90)."
    )
    steep = AREAS | {("denoised", 20): (0.6, 0.55, 0.65)}
    assert "from denoised from t = 20 (0.60) to denoised from t = 400 (0.93)" in page(steep).verdict()


def test_the_verdict_says_when_nothing_is_told_or_measured():
    alike = dict.fromkeys(KEYS, (0.51, 0.45, 0.56))
    assert page(alike).verdict().startswith("In no row are frames told from recorded ones")
    unknown = dict.fromkeys(KEYS, (None, None, None))
    verdict = page(unknown, note="fewer than 40 frames in a set").verdict()
    assert verdict == "Nothing can be said about what is told apart: fewer than 40 frames in a set."


def test_tables_have_a_row_a_part_and_what_is_certain_is_bold():
    lost, unsure = (-0.1, -0.12, -0.08), (0.01, -0.02, 0.03)
    made = page(AREAS, [(("recorded", 0), (None,) * 3), (("values", 0), unsure), (("denoised", 20), lost)])
    areas, changes, grid, more = made.sections()
    assert isinstance(areas, Table) and isinstance(changes, Table) and isinstance(grid, ImageGrid)
    assert [cells[0] for cells in areas.rows] == [
        "recorded", "autoencoder", "values as in sampling", "denoised from t = 20", "denoised from t = 400",
        "sampled in 12 steps",
    ]  # fmt: skip
    assert areas.bold == {(3, 2), (4, 2), (5, 2)}, "the floor is no part of the generator"
    assert areas.rows[3][1:] == [20, "0.900 [0.860, 0.940]", 80, 0.2]
    assert [cells[1] for cells in changes.rows] == [
        None, "+0.010 [-0.020, +0.030]", "-0.100 [-0.120, -0.080]", None, None,
    ]  # fmt: skip
    assert changes.bold == {(2, 1)}
    assert [label for label, _ in grid.rows] == [cells[0] for cells in areas.rows]
    assert all(len(images) == GRID_COLUMNS for _, images in grid.rows)
    assert isinstance(more, Folded)
    html = render_report(title="t", lead="", verdict=made.verdict(), sections=made.sections())
    assert "denoised from t = 400" in html


def test_notes_name_their_row():
    areas, *_ = page({("recorded", 0): (None, None, None), ("values", 0): (0.5, 0.4, 0.6)}, note="why").sections()
    assert isinstance(areas, Table) and list(areas.footnotes) == ["recorded: why.", "values as in sampling: why."]


@pytest.mark.parametrize("count", [3, 200])
def test_few_frames_are_all_shown(count):
    pictures = {("recorded", 0): np.zeros((count, 4, 4, 3), np.uint8)}
    grid = ChainPage([row(("recorded", 0), "c2st", 0.5)], pictures).sections()[2]
    assert isinstance(grid, ImageGrid) and len(grid.rows[0][1]) == min(count, GRID_COLUMNS)
