"""The documentation as a site: it builds without a warning, has every page, and needs no network to be read."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys

import pytest
from browser import CHROMIUM, check_pages
from doc_pages import PAGES, REPOSITORY

from ctlev_core import plugins
from data_contracts.experiment import Experiment

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not all(importlib.util.find_spec(name) for name in ("material", "mkdocstrings")),
        reason="mkdocs is not installed: pip install -c constraints.txt -e '.[docs]'",
    ),
]
_LOADED = re.compile(r"<(?:script|img|iframe|source)[^>]*\ssrc=\"?(https?:)?//|<link[^>]*\shref=\"?(https?:)?//")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    built = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    return folder


def test_every_page_is_there(site):
    named = {path.relative_to(REPOSITORY / "docs").with_suffix(".html") for path in PAGES if path.parent != REPOSITORY}
    made = {path.relative_to(site) for path in site.rglob("*.html")}
    assert named <= made
    assert {"index.html", "changelog.html", "contributing.html", "benchmarks.html"} <= {path.name for path in made}


def test_every_option_is_in_the_reference(site):
    text = (site / "reference" / "options_experiments.html").read_text(encoding="utf-8")
    assert not [name for name in Experiment.model_fields if f"<code>{name}</code>" not in text]
    for kind in ("datasets", "encodings", "conditions", "generators", "downstream", "metrics"):
        text = (site / "reference" / f"options_{kind}.html").read_text(encoding="utf-8")
        for name in plugins.names(kind):
            fields = plugins.load(kind, name).Options.model_fields
            assert not [field for field in fields if f"<code>{field}</code>" not in text], f"{kind}/{name}"


def test_nothing_is_loaded_from_elsewhere(site):
    for page in site.rglob("*.html"):
        assert not _LOADED.search(page.read_text(encoding="utf-8")), page.name
    for sheet in site.rglob("*.css"):
        assert not re.search(r"url\(['\"]?(https?:)?//|@import", sheet.read_text(encoding="utf-8")), sheet.name


@pytest.mark.release
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
def test_every_page_can_be_read_at_every_width(site, tmp_path):
    pages = sorted(str(path.relative_to(site)) for path in site.rglob("*.html"))
    for start in range(0, len(pages), 10):
        check_pages(site, pages[start : start + 10], tmp_path)
