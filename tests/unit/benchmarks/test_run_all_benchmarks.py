"""The page of all benchmarks: what was judged, what failed, and what did not run."""

import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[3] / "benchmarks"


@pytest.fixture
def run_all(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import run_all

    monkeypatch.setattr(run_all, "KEPT", tmp_path / "kept")
    monkeypatch.setattr(run_all, "RESULTS", tmp_path / "RESULTS.md")
    return run_all


def test_every_benchmark_is_a_script(run_all):
    for benchmark in run_all.ALL:
        assert (BENCHMARKS / f"{benchmark.script or benchmark.name}.py").exists()


def test_what_ran_and_what_did_not(run_all, monkeypatch, tmp_path):
    (tmp_path / "quick.py").write_text("import sys\nprint('1.6x, wanted 1.5x: met\\nsolving')\nsys.exit(3)")
    monkeypatch.setattr(run_all, "HERE", tmp_path)
    monkeypatch.setattr(run_all, "ALL", (run_all.Benchmark("quick"), run_all.Benchmark("other", needs_gpu=True)))
    monkeypatch.setattr(run_all, "_has_gpu", lambda: False)
    monkeypatch.setattr(sys, "argv", ["run_all.py"])
    assert run_all.main() == 1
    page = (tmp_path / "RESULTS.md").read_text()
    assert "Not run here: `other`." in page
    assert "- 1.6x, wanted 1.5x: met\n" in page and "**It ended with status 3.**" in page
    assert "- solving" not in page and "solving\n```" in page


def test_what_is_not_run_anew_stays_on_the_page(run_all, monkeypatch, tmp_path):
    """In a fresh clone, where nothing of earlier runs is kept, and with a section that somebody wrote."""
    (tmp_path / "quick.py").write_text("print('2.0x, wanted 1.5x: met')")
    (tmp_path / "RESULTS.md").write_text(
        "# Benchmarks\n\nMade by hand.\n\n## quick\n\nold\n\n## slow\n\nas it was\n\n## robustness\n\nby hand\n"
    )
    monkeypatch.setattr(run_all, "HERE", tmp_path)
    monkeypatch.setattr(run_all, "ALL", tuple(map(run_all.Benchmark, ("slow", "quick", "never"))))
    monkeypatch.setattr(sys, "argv", ["run_all.py", "quick"])
    assert run_all.main() == 0
    page = (tmp_path / "RESULTS.md").read_text()
    assert "old" not in page and "- 2.0x, wanted 1.5x: met\n" in page and "Not run here: `never`." in page
    order = [page.index(text) for text in ("## slow\n\nas it was\n", "## quick\n", "## robustness\n\nby hand\n")]
    assert order == sorted(order)


def test_unknown_names_are_refused(run_all, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["run_all.py", "trainig"])
    with pytest.raises(SystemExit) as ended:
        run_all.main()
    assert ended.value.code == 2
    assert "no such benchmark: trainig; there are events, rendering" in capsys.readouterr().err
