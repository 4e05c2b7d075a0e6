"""Find the report of a run, and open it."""

from __future__ import annotations

import os
import sys
import webbrowser
from pathlib import Path

from ctlev_core.report.page.report_files import PAGE
from data_contracts.errors import DataError
from data_contracts.renamed_options import name_hint
from tasks.store import Store


def show_report(name: str | None, home: Path, *, open_page: bool | None = None) -> int:
    """Print the path of a report, and open it in a browser.

    Args:
        name: as `find_page` takes it.
        home: folder of all state.
        open_page: None = where standard output is a terminal and there is a display.

    Returns:
        Exit status: 0 found, 2 not.
    """
    try:
        Store(home).fetch_files()
    except DataError as error:
        print(f"only what is in {home}: {error}", file=sys.stderr)
    page, problem = find_page(name, home)
    if page is None:
        print(f"error: {problem}", file=sys.stderr)
        return 2
    print(page)
    if open_page is None:
        has_display = sys.platform in ("darwin", "win32") or "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
        open_page = sys.stdout.isatty() and has_display
    if open_page and not webbrowser.open(page.as_uri()):
        print("no browser was found; open the file yourself", file=sys.stderr)
    return 0


def find_page(name: str | None, home: Path) -> tuple[Path | None, str]:
    """The page of a report, absolute; or None and why there is none.

    Args:
        name: of a report of the home, or the first digits, six or more, of the key of a report's artefact, or the path
            of a page or of the folder beside it; None = the newest of the home.
        home: folder of all state.
    """
    by_age = sorted((home / "reports").glob("*.html"), key=lambda path: path.stat().st_mtime)
    pages = {path.stem: path for path in by_age}
    if name is None:
        return (by_age[-1], "") if by_age else (None, f"{home}: holds no report yet; `ctlev run` makes one")
    if name in pages:
        return pages[name], ""
    for path in (
        () if not Path(name).name else (Path(name), Path(name).with_name(f"{Path(name).name}.html"), Path(name) / PAGE)
    ):
        if os.path.isfile(path):  # False of a name that is too long for a file, where `is_file` raises
            return path.absolute(), ""
    if len(name) >= 6 and set(name) <= set("0123456789abcdef"):
        found = sorted((home / "artefacts").glob(f"*report*/{name}*/{PAGE}"))
        if len(found) == 1:
            return found[0], ""
    known = f"it has {', '.join(sorted(pages))}" if pages else "it has none"
    return None, f"{home}: has no report {name!r}{name_hint(name, pages, {})}; {known}"
