"""What lies in the folder of a report, and where a person finds it."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from data_contracts.manifest import MANIFEST_FILE, ManifestRef

PAGE, LATEX, MARKDOWN, PROVENANCE = "report.html", "tables.tex", "tables.md", "provenance.json"
_ANSWER = re.compile(r"\b(helped?|did harm|made it (better|worse)|is undecided|changed nothing|too few)\b")
_SENTENCE_END = re.compile(r"(?<=[.?])\s+(?=[A-Z])")
_HEADING = re.compile(r"[^.:]*\([^()]+\): ")
"""Of the paragraph of an experiment in a study."""


def publish_report(ref: ManifestRef, home: Path, name: str) -> str:
    """Put the newest report of an experiment where a person looks for it, and say where that is.

    `<home>/reports/NAME.html`, and in the folder `NAME` beside it the tables and `provenance.json`; of a study also the
    reports of its experiments, a folder each.
    """
    folder = home / "reports"
    (folder / name).mkdir(parents=True, exist_ok=True)
    parts = [path for path in ref.path.iterdir() if path.is_dir()]  # of a study
    for place in (ref.path, *parts):
        (folder / name / place.relative_to(ref.path)).mkdir(exist_ok=True)
        for path in published_files(place):
            if path != ref.path / PAGE:
                _replace(path, folder / name / path.relative_to(ref.path))
    _replace(ref.path / PAGE, folder / f"{name}.html")
    return f"report: {folder / f'{name}.html'}\ntables: {folder / name}"


def read_verdict(folder: Path) -> str:
    """The sentence of a report that says whether synthetic data helped; empty where no report lies in the folder.

    It is the first that says so in the paragraphs above the first table of `tables.md`; of several experiments each has
    one, with the heading of its paragraph.
    """
    if not (folder / MARKDOWN).is_file():
        return ""
    above = (folder / MARKDOWN).read_text(encoding="utf-8").partition("\n## ")[0].replace("\\", "")
    paragraphs = [paragraph.strip() for paragraph in above.split("\n\n")[2:]]
    found = []
    for paragraph in paragraphs:
        sentences, heading = _SENTENCE_END.split(paragraph), _HEADING.match(paragraph)
        answer = next((one for one in sentences if _ANSWER.search(one)), None)
        if answer is not None:
            found.append(answer if heading is None or answer.startswith(heading[0]) else heading[0] + answer)
    return "\n".join(found) or (_SENTENCE_END.split(paragraphs[0])[0] if paragraphs else "")


def publish_page(ref: ManifestRef, table: str, home: Path, name: str) -> Path:
    """Put a page of one file, and its table, where a person looks for them: `<home>/reports/NAME.html` and `.parquet`.

    Args:
        ref: the artefact; it holds `PAGE` and the table.
        table: file name of the table.
        home: of the store.
        name: of the page.
    Returns:
        Where the page is.
    """
    folder = home / "reports"
    folder.mkdir(parents=True, exist_ok=True)
    _replace(ref.path / table, folder / f"{name}.parquet")
    _replace(ref.path / PAGE, folder / f"{name}.html")
    return folder / f"{name}.html"


def published_files(folder: Path) -> list[Path]:
    """What a person wants of a report's files."""
    wanted = (PAGE, LATEX, MARKDOWN, PROVENANCE)
    tables_of = (path for path in folder.glob("*.parquet") if path.name != MANIFEST_FILE)
    return sorted([*(folder / name for name in wanted if (folder / name).exists()), *tables_of])


def _replace(source: Path, target: Path) -> None:
    """Copy a file so that whoever reads the target sees the old one or the new one."""
    temporary = target.with_name(f".{target.name}")
    shutil.copyfile(source, temporary)
    temporary.replace(target)
