"""Two runs of one experiment that put their results where a person looks for them at the same moment."""

import threading
from concurrent.futures import ThreadPoolExecutor

from ctlev_core.report.page.report_files import publish_report
from data_contracts.manifest import ManifestRef
from flows.local_server import _private
from tasks.export_events import publish_events

NUM_FILES, ROUNDS = 60, 5


def twice_at_once(function):
    """Call a function in two threads, which begin together, several times."""
    barrier = threading.Barrier(2)  # begins anew when both have passed
    with ThreadPoolExecutor(2) as threads:
        for _ in range(ROUNDS):
            for finished in [threads.submit(lambda: (barrier.wait(), function())) for _ in range(2)]:
                finished.result()


def test_events_are_whole(tmp_path):
    artefact = tmp_path / "artefact"
    (artefact / "events").mkdir(parents=True)
    for number in range(NUM_FILES):
        (artefact / "events" / f"{number:06d}.parquet").write_bytes(b"x" * 20_000)
    (artefact / "manifest.parquet").write_bytes(b"m")
    ref = ManifestRef(key="0" * 32, path=artefact, rows=NUM_FILES)
    twice_at_once(lambda: publish_events(ref, tmp_path / "home", "pose"))
    assert len(list((tmp_path / "home/events/pose/events").iterdir())) == NUM_FILES
    assert [path.name for path in (tmp_path / "home/events").iterdir()] == ["pose"]


def test_pages_are_whole(tmp_path):
    artefact = tmp_path / "artefact"
    artefact.mkdir()
    page = "<html>" + "x" * 2_000_000
    (artefact / "report.html").write_text(page)
    (artefact / "tables.md").write_text("table")
    ref = ManifestRef(key="0" * 32, path=artefact)
    twice_at_once(lambda: publish_report(ref, tmp_path / "home", "demo"))
    reports = tmp_path / "home" / "reports"
    assert (reports / "demo.html").read_text() == page
    assert sorted(path.name for path in reports.iterdir()) == ["demo", "demo.html"]


def test_each_server_has_a_log_that_others_may_not_read(tmp_path):
    for number in range(2):  # the second takes the place of the first
        with _private(tmp_path / "server.log") as log:
            log.write(str(number).encode())
    assert (tmp_path / "server.log").read_text() == "1"
    assert (tmp_path / "server.log").stat().st_mode & 0o777 == 0o600 and len(list(tmp_path.iterdir())) == 1
