"""What is written into a page when it is published: when, by what and where it was made, and how long that took."""

import json

import pytest

from ctlev_core.report.page.html import render_report
from ctlev_core.report.page.report_files import publish_report
from data_contracts.manifest import ManifestRef
from data_contracts.run_record import RunRecord, write_run_record

KEY = "a" * 32


@pytest.fixture
def made(tmp_path):
    """A report's artefact, of two stages that took 100 s."""
    folder = tmp_path / KEY
    folder.mkdir()
    page = render_report(title="t", lead="l", verdict="v", sections=[])
    (folder / "report.html").write_text(page, encoding="utf-8")
    stages = [{"key": name, "wall_seconds": seconds} for name, seconds in (("x", 60.0), ("y", 40.0))]
    (folder / "provenance.json").write_text(json.dumps({"stages": stages}))
    return folder


def record(**versions: str) -> RunRecord:
    return RunRecord(
        stage="report", stage_version=1, key=KEY, digest="0" * 64, arguments={}, upstream={}, versions=versions,
        started="2026-01-02T03:04:05Z", wall_seconds=1, cpu_seconds=1, process_peak_memory_mib=1,
    )  # fmt: skip


def test_a_published_page_says_when_by_what_and_where_it_was_made(made, tmp_path):
    write_run_record(made, record(ctlev="9.8.7", commit="0123abc", platform="Linux <x>", cores="2"))
    stored = (made / "report.html").read_bytes()
    publish_report(ManifestRef(key=KEY, path=made), tmp_path, "t")
    page = (tmp_path / "reports" / "t.html").read_text(encoding="utf-8")
    assert (
        '<p class="facts">Made 2026-01-02 03:04 UTC · ctlev 9.8.7 · commit 0123abc · Linux &lt;x&gt; · 2 cores · its '
        "stages took 1 min 40 s in all</p>"
    ) in page
    assert (made / "report.html").read_bytes() == stored and b"9.8.7" not in stored


def test_a_page_without_a_record_is_published_as_it_is(made, tmp_path):
    publish_report(ManifestRef(key=KEY, path=made), tmp_path, "t")
    assert (tmp_path / "reports" / "t.html").read_bytes() == (made / "report.html").read_bytes()
