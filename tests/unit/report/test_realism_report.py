"""The realism sections of the report."""

from __future__ import annotations

from ctlev_core.report.page.html import Curves, Table, render_report
from ctlev_core.report.sections.realism import realism_sections


def row(group: str, training_set: str, metric: str, value: float, low: float | None = None, high: float | None = None):
    return {
        "group": group, "subject": training_set, "metric": metric, "value": value, "low": low, "high": high,
        "num_samples": {"recorded": 6, "synthetic": 9}.get(training_set, 5),
    }  # fmt: skip


ROWS = [
    row("events", "train", "spread", 0.5),
    row("events", "test", "spread", 0.75),
    row("events", "test against train", "spread", 0.25),
    row("events", "train against train", "spread", 0.1),
    row("frames", "recorded", "speckle_share", 0.25, 0.2, 0.3),
    row("frames", "synthetic", "speckle_share", 0.05),
    row("frames", "synthetic against recorded", "speckle_share", 0.2, 0.1, 0.3),
    row("frames", "synthetic against recorded", "value_js_bits", 0.01),
    row("frames", "recorded against recorded", "speckle_share", 0.02, 0.0, 0.04),
    row("frames", "recorded against recorded", "value_js_bits", 0.02, 0.0, 0.04),
]
DISTRIBUTIONS = [
    {"group": "frames", "subject": training_set, "axis": axis, "centre": centre, "share": share}
    for training_set, shares in (("recorded", (0.75, 0.25)), ("synthetic", (0.5, 0.5)))
    for axis in ("value", "other")
    for centre, share in zip((26.0, 27.0), shares, strict=True)
]


def test_frames_come_first_with_both_sets_their_distance_and_the_floor():
    frames, values, events = realism_sections(ROWS, DISTRIBUTIONS)
    assert isinstance(frames, Table) and isinstance(values, Curves) and isinstance(events, Table)
    assert frames.columns == ["number", "recorded (6)", "synthetic (9)", "ratio", "distance", "floor: recorded, halves"]
    assert frames.rows == [
        ["speckle, share", "0.25 [0.2, 0.3]", "0.05", "0.2", "0.2 [0.1, 0.3]", "0.02 [0, 0.04]"],
        ["brightness, Jensen-Shannon divergence, bits", "", "", "", "0.01", "0.02 [0, 0.04]"],
    ]
    assert events.rows == [["spread over the sensor", "0.5", "0.75", "1.5", "0.25", "0.1"]]


def test_bold_is_what_lies_above_the_interval_of_the_floor():
    frames, _, events = realism_sections(ROWS, DISTRIBUTIONS)
    assert isinstance(frames, Table) and isinstance(events, Table)
    assert set(frames.bold) == {(0, 4)}
    assert not events.bold  # the floor has no interval, so nothing is known


def test_a_ratio_beyond_a_factor_of_ten_is_bold():
    numbers = [(0.05, 0.6), (0.05, 0.004), (0.05, 0.4), (0.0, 0.4)]
    rows = [
        row("reference", training_set, f"number{i}", value)
        for i, pair in enumerate(numbers)
        for training_set, value in zip(("reference", "train"), pair, strict=True)
    ]
    (table,) = realism_sections(rows, [])
    assert isinstance(table, Table) and table.title == "How alike are the recordings and the reference?"
    assert [cells[3] for cells in table.rows] == ["12", "0.08", "8", ""] and set(table.bold) == {(0, 3), (1, 3)}


def test_frames_of_baselines_have_tables_of_their_own_and_a_line_in_the_chart():
    baseline = [
        {**one, "group": "frames of gan", "subject": one["subject"].replace("synthetic", "gan")} for one in ROWS[4:]
    ]
    more = [
        {**one, "group": "frames of gan", "subject": one["subject"].replace("synthetic", "gan")}
        for one in DISTRIBUTIONS
    ]
    _, values, of_gan, _ = realism_sections([*ROWS, *baseline], [*DISTRIBUTIONS, *more])
    assert isinstance(of_gan, Table) and of_gan.title == "How real do the frames of GAN look?"
    assert isinstance(values, Curves) and list(values.series) == ["recorded", "synthetic", "GAN"]
    assert values.series["recorded"] == ([26.0, 27.0], [0.75, 1.0])


def test_large_numbers_are_written_out():
    (table,) = realism_sections([row("events", "train", "pixel_rate_hz", 12345.6, 110.4, 0.000123)], [])
    assert isinstance(table, Table) and table.rows[0][1] == "12346 [110, 0.00012]"


def test_the_chart_adds_the_shares_up():
    values = realism_sections(ROWS, DISTRIBUTIONS)[1]
    assert isinstance(values, Curves)
    assert values.series == {"recorded": ([26.0, 27.0], [0.75, 1.0]), "synthetic": ([26.0, 27.0], [0.5, 1.0])}


def test_what_is_missing_is_left_out():
    assert realism_sections([], []) == []
    (only,) = realism_sections([row("events", "train", "spread", 0.5)], [])
    assert isinstance(only, Table) and only.rows == [["spread over the sensor", "0.5", "", "", "", ""]]
    page = render_report(title="t", lead="", verdict="", sections=realism_sections(ROWS, DISTRIBUTIONS))
    assert "How real do the synthetic frames look?" in page and "<svg" in page


def told(training_set: str, value: float | None, low: float | None, high: float | None, note: str = "") -> dict:
    return {
        "group": "frames", "subject": training_set, "value": value, "low": low, "high": high,
        "deviation": value and 0.0123,
        "num_first": 50, "num_second": 50, "note": note,
    }  # fmt: skip


def test_the_two_sample_tests_of_all_generators_stand_below_those_of_recorded_frames():
    tests = [
        told("synthetic against recorded", 0.75, 0.625, 0.875),
        told("gan against test", None, None, None, "fewer than 40 frames in a set"),
        told("recorded against recorded", 0.5, 0.375, 0.625),
        told("test against recorded", 0.625, None, None),
    ]
    frames, table, values, _ = realism_sections(ROWS, DISTRIBUTIONS, tests)
    assert isinstance(frames, Table) and isinstance(values, Curves) and isinstance(table, Table)
    assert table.rows == [
        ["recorded training frames: halves", "0.500 [0.375, 0.625]", "0.012", "50 + 50", ""],
        ["recorded training from recorded test frames", "0.625", "0.012", "50 + 50", ""],
        ["synthetic from recorded training frames", "0.750 [0.625, 0.875]", "0.012", "50 + 50", ""],
        ["GAN from recorded test frames", None, None, "50 + 50", "fewer than 40 frames in a set"],
    ]
    assert set(table.bold) == {(2, 1)}
    page = render_report(title="t", lead="", verdict="", sections=[table])
    assert "fewer than 40 frames in a set" in page


def test_power_spectra_are_a_chart():
    spectra = [{**one, "axis": "power_spectrum"} for one in DISTRIBUTIONS if one["axis"] == "value"]
    empty = [{**one, "axis": "power_spectrum", "centre": 25.0, "share": 0.0} for one in spectra[::2]]
    _, chart, _ = realism_sections(ROWS, [*empty, *spectra])
    assert isinstance(chart, Curves) and chart.title == "Power spectrum" and chart.log_y
    assert chart.series == {"recorded": ([26.0, 27.0], [0.75, 0.25]), "synthetic": ([26.0, 27.0], [0.5, 0.5])}
