"""What lies in the folder of a report, and where a person finds it."""

from __future__ import annotations

import html
import json
import re
import shutil
import uuid
from pathlib import Path

from ctlev_core.duration_text import duration_text
from data_contracts.manifest import MANIFEST_FILE, ManifestRef
from data_contracts.run_record import RUN_FILE, RunRecord, read_run_record

PAGE, LATEX, MARKDOWN, PROVENANCE = "report.html", "tables.tex", "tables.md", "provenance.json"
FACTS = "<!-- date, version and machine: filled in when the page is published -->"
"""Its place in a page: what is stored has none of them, so that equal results are equal pages."""
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
                publish_file(path, folder / name / path.relative_to(ref.path), facts=page_facts(ref.path, place))
    publish_file(ref.path / PAGE, folder / f"{name}.html", facts=page_facts(ref.path, ref.path, *parts))
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
    publish_file(ref.path / table, folder / f"{name}.parquet")
    publish_file(ref.path / PAGE, folder / f"{name}.html", facts=page_facts(ref.path))
    return folder / f"{name}.html"


def published_files(folder: Path) -> list[Path]:
    """What a person wants of a report's files."""
    wanted = (PAGE, LATEX, MARKDOWN, PROVENANCE)
    tables_of = (path for path in folder.glob("*.parquet") if path.name != MANIFEST_FILE)
    return sorted([*(folder / name for name in wanted if (folder / name).exists()), *tables_of])


def page_facts(artefact: Path, *places: Path) -> str:
    """When, by which version and where a page was made, and how long all that it tells of took; as HTML.

    Args:
        artefact: folder of the page's artefact; without a provenance record there, nothing is said.
        places: folders whose `provenance.json` lists what is behind the page.
    """
    if not (artefact / RUN_FILE).is_file():
        return ""
    record = read_run_record(artefact)
    spent = {
        stage["key"]: stage["wall_seconds"]
        for place in places
        if (place / PROVENANCE).is_file()
        for stage in json.loads((place / PROVENANCE).read_text(encoding="utf-8"))["stages"]
    }
    told = _made_by(record) + ([f"its stages took {duration_text(sum(spent.values()))} in all"] if spent else [])
    return html.escape(" · ".join(told))


def _made_by(record: RunRecord) -> list[str]:
    known = record.versions
    told = [f"Made {record.started[:16].replace('T', ' ')} UTC"]
    told += [f"{words} {known[name]}" for name, words in (("ctlev", "ctlev"), ("commit", "commit")) if name in known]
    told += [known["platform"]] if "platform" in known else []
    return [*told, *([f"{known['cores']} cores"] if "cores" in known else [])]


def publish_file(source: Path, target: Path, facts: str = "") -> None:
    """Copy a file so that whoever reads the target sees the old one or the new one; pages with their facts."""
    temporary = target.with_name(f".{target.name}.{uuid.uuid4().hex}")  # two runs may publish at once
    if facts and source.suffix == ".html":
        temporary.write_text(source.read_text(encoding="utf-8").replace(FACTS, facts, 1), encoding="utf-8")
    else:
        shutil.copyfile(source, temporary)
    temporary.replace(target)
