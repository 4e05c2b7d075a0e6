"""Which samples the report shows in motion."""

from tasks.report import _runs


def test_runs_are_rows_that_follow_in_the_time_of_one_recording():
    sources = ["a:0", "a:100", "a:200", "b/c:50", "b/c:150", "b/c:20", "d", "d", "a:300"]
    runs = [(name, rows.tolist(), step) for name, rows, step in _runs(sources)]
    assert runs == [("a", [0, 1, 2], 100.0), ("b/c", [3, 4], 100.0)]
