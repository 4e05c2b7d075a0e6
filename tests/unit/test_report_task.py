"""What the report picks out of manifests."""

from ctlev_core.report.pictures import runs


def test_runs_are_rows_that_follow_in_the_time_of_one_recording():
    sources = ["a:0", "a:100", "a:200", "b/c:50", "b/c:150", "b/c:20", "d", "d", "a:300"]
    found = [(name, rows.tolist(), step) for name, rows, step in runs(sources)]
    assert found == [("a", [0, 1, 2], 100.0), ("b/c", [3, 4], 100.0)]
