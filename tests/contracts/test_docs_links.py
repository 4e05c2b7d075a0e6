"""Every link, file, module and preset that the documentation names exists."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from doc_pages import PAGES, REPOSITORY, anchors, inline_code, links, name_of

from flows.command_line import PRESETS

FOLDERS = ("flows", "tasks", "ctlev_core", "data_contracts", "tests", "benchmarks", "docs")
_FILE = re.compile(rf"(?<![\w/.])((?:{'|'.join(FOLDERS)})/[\w/.\-]*)")
_MODULE = re.compile(r"(?<![\w/.\-])((?:flows|tasks|ctlev_core|data_contracts)(?:\.\w+)+)")
_PRESET = re.compile(r"--preset ([a-z]\w*)(?![\w./])")


def missing_links(page: Path) -> list[str]:
    """Relative links of a page that lead nowhere."""
    wrong = []
    for target in links(page):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        place = (page.parent / path).resolve() if path else page
        if not place.exists() or (anchor and anchor not in anchors(place)):
            wrong.append(target)
    return wrong


def named_in(page: Path, pattern: re.Pattern[str]) -> set[str]:
    """What inline code and code blocks of a page name."""
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"```\w*\n(.*?)```", text, re.DOTALL)
    return {match for code in [*inline_code(page), *blocks] for match in pattern.findall(code)}


def is_module(name: str) -> bool:
    """Is there such a module, or one that says such a name? Nothing is imported: torch takes seconds."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        place = REPOSITORY.joinpath(*parts[:length])
        file = place.with_suffix(".py")
        if length == len(parts) and (file.is_file() or place.is_dir()):
            return True
        source = file if file.is_file() else place / "__init__.py"
        if source.is_file():
            return re.search(rf"\b{parts[length]}\b", source.read_text(encoding="utf-8")) is not None
    return False


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_and_anchors_resolve(page):
    assert not missing_links(page)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_files_modules_and_presets_exist(page):
    files = {name.rstrip("./") for name in named_in(page, _FILE)}
    examples = set(re.findall(r"^# (ctlev_core/\w+/\w+\.py)$", page.read_text(encoding="utf-8"), re.MULTILINE))
    assert not [name for name in files - examples if not (REPOSITORY / name).exists()]
    assert not [name for name in named_in(page, _MODULE) if not name.endswith(".py") and not is_module(name)]
    known = {path.stem for path in PRESETS.rglob("*.yaml")}
    assert not named_in(page, _PRESET) - known


def test_what_is_missing_is_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "# One `a_b`: two\n\n# One `a_b`: two\n\n[a](#one-a_b-two) [b](#one-a_b-two-1) [c](#one) [d](gone.md)\n"
        "[e](page.md#one-a_b-two) `[f](x.md)`\n"
    )
    assert missing_links(page) == ["#one", "gone.md"]
    assert is_module("ctlev_core.export.event_dataset.EventDataset") and is_module("tasks.workers.map_shards")
    assert not is_module("ctlev_core.export.gone") and not is_module("tasks.workers.gone_for_good")
