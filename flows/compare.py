"""What differs between two finished experiments: options, data, code and scores.

python flows/compare.py RUN_A RUN_B [--home FOLDER]

A run is the name of a report in the home, the key of a report's artefact (its first digits will do), or the path of a
report, of its folder, or of a file in it. Of one name the newest report is in `reports`; older ones have their keys.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from ctlev_core.report.page.html import render_report
from ctlev_core.report.page.tables import Table, markdown_table
from ctlev_core.report.studies.run_comparison import Run, compare_runs, find_run, read_run
from data_contracts.errors import DataError
from data_contracts.home_folder import home_folder
from flows.cli import script
from flows.settings import flow
from tasks.store import Store


@flow(name="compare")
def compare(run_a: str, run_b: str, home: str | None = None) -> Path:
    """Compare two finished experiments; write a page and return its path.

    Args:
        run_a: name, key or path of a report.
        run_b: of another.
        home: folder of all state, or URL of a bucket; by default that of the process.
    """
    folder = home_folder(home)
    return write_comparison(*_read_runs(run_a, run_b, folder), folder)[0]


def _read_runs(run_a: str, run_b: str, home: Path) -> tuple[Run, Run]:
    Store(home).fetch_files()
    folders = [find_run(run, home) for run in (run_a, run_b)]
    first, second = (_short(folder.name) for folder in folders)
    return read_run(first, folders[0]), read_run(second if second != first else f"{second} (B)", folders[1])


def _short(name: str) -> str:
    """A name as it is, and as much of a key as tells it from others."""
    return name[:12] if re.fullmatch(r"[0-9a-f]{32}", name) else name


def write_comparison(first: Run, second: Run, home: Path) -> tuple[Path, list[Table]]:
    """The page of a comparison, and its tables."""
    found = compare_runs(first, second)
    page = render_report(
        title=f"{first.name} and {second.name}",
        lead="Two finished experiments, and what differs between them.",
        verdict=_summary(found),
        sections=found,
    )
    names = [re.sub(r"[^A-Za-z0-9.-]+", "_", run.name).strip("_.") for run in (first, second)]
    path = home / "reports" / f"compare_{names[0]}_{names[1]}.html"
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}")
    temporary.write_text(page, encoding="utf-8")
    temporary.replace(path)
    Store(home).send_files()
    return path, found


def _summary(found: list[Table]) -> str:
    scores, *others = found
    counts = ", ".join(f"{len(table.rows)} in {table.title.lower()}" for table in others)
    compared = sum(bool(row[-1]) for row in scores.rows)
    return f"{len(scores.bold)} of {compared} scores differ for certain. Differences: {counts}."


def print_comparison(run_a: str, run_b: str, home: Path) -> int:
    """Write the page and print its tables; exit status: 0 done, 2 a run cannot be read."""
    try:
        path, found = write_comparison(*_read_runs(run_a, run_b, home), home)
    except (DataError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print("A star: the interval excludes 0.\n")
    for table in found:
        print(f"{table.title}. {table.caption}\n\n{markdown_table(table, plain=True)}\n")
    print(f"{_summary(found)}\ncomparison: {path}")
    return 0


if __name__ == "__main__":
    sys.exit(script("compare"))
