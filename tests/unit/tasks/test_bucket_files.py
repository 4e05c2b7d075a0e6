"""Reports, versions, events and the ledger of openings of several machines in one bucket."""

import json
from concurrent.futures import ThreadPoolExecutor

import bucket_server
import pytest

from data_contracts.errors import DataError
from data_contracts.experiment import Experiment
from data_contracts.home_folder import home_folder
from data_contracts.published import StoredArtefact, Version, published_folder, read_latest, read_versions
from data_contracts.regeneration import Gates
from flows.command_line import PRESETS, load_preset
from flows.show import find_page, show_report
from tasks.bucket import Bucket, BucketError
from tasks.bucket_files import fetch_files, send_files
from tasks.openings import note_opening
from tasks.publish import claimed


@pytest.fixture
def machine(bucket_url, tmp_path, monkeypatch):
    """The cache of the bucket on the machine of a name."""

    def home(name):
        monkeypatch.setenv("CTLEV_CACHE", str(tmp_path / name))
        return home_folder(bucket_url)

    return home


@pytest.fixture
def bucket(bucket_url):
    return Bucket(bucket_url)


def write(home, name, text):
    path = home / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def test_reports_reach_other_machines_and_the_newest_stays(machine, bucket):
    first, second = machine("a"), machine("b")
    write(first, "reports/demo.html", "one")
    write(first, "reports/demo/tables.md", "table")
    write(first, "reports/.demo.html", "half")
    assert send_files(first, bucket) == 2 and send_files(first, bucket) == 0
    assert fetch_files(second, bucket) == 2 and fetch_files(second, bucket) == 0
    assert (second / "reports/demo/tables.md").read_text() == "table" and not (second / "reports/.demo.html").exists()
    assert send_files(second, bucket) == 0, "what was fetched is not sent back"
    write(second, "reports/demo.html", "two")
    assert send_files(second, bucket) == 1
    write(first, "reports/demo/tables.md", "table")
    assert send_files(first, bucket) == 0, "written anew with the same content"
    assert fetch_files(first, bucket) == 1 and (first / "reports/demo.html").read_text() == "two"


def test_what_could_not_be_sent_is_sent_by_the_next_run(machine, bucket, monkeypatch):
    home = machine("a")
    write(home, "reports/demo.html", "Monday")
    send_files(home, bucket)
    write(home, "reports/demo.html", "Tuesday")

    def fail(path, name):
        raise BucketError("the network is down")

    with monkeypatch.context() as without, pytest.raises(BucketError, match="down"):
        without.setattr(bucket, "send", fail)
        send_files(home, bucket)
    assert fetch_files(home, bucket) == 0 and (home / "reports/demo.html").read_text() == "Tuesday"
    assert send_files(home, bucket) == 1 and fetch_files(machine("b"), bucket) == 1
    assert (machine("b") / "reports/demo.html").read_text() == "Tuesday"


def test_show_finds_the_report_of_another_machine(machine, bucket, capsys):
    first, second = machine("a"), machine("b")
    write(first, "reports/demo.html", "one")
    send_files(first, bucket)
    assert find_page("demo", second)[0] is None
    assert show_report("demo", second, open_page=False) == 0
    assert capsys.readouterr().out == f"{second / 'reports/demo.html'}\n"


def test_show_opens_what_is_in_the_cache_where_the_bucket_cannot_be_reached(machine, bucket, capsys, monkeypatch):
    home = machine("a")
    write(home, "reports/demo.html", "one")
    bucket_server.remove_bucket(bucket.url)
    assert show_report("demo", home, open_page=False) == 0
    said = capsys.readouterr()
    assert said.out == f"{home / 'reports/demo.html'}\n" and f"only what is in {home}: {bucket.url}: " in said.err


def test_an_object_that_leads_out_of_the_home_is_refused(machine, bucket, monkeypatch):
    monkeypatch.setattr(Bucket, "list", lambda self, folder: {"../../x": {"size": 1, "ETag": "1"}})
    with pytest.raises(DataError, match=r"reports/\.\./\.\./x: leads out of the home"):
        fetch_files(machine("a"), bucket)


def test_a_report_that_is_removed_after_it_was_listed_is_passed_over(machine, bucket, monkeypatch):
    for name in ("one", "two"):
        write(machine("a"), f"reports/{name}.html", name)
    send_files(machine("a"), bucket)
    listed = Bucket.list

    def list_and_lose(self, folder):
        found = listed(self, folder)
        bucket.delete("reports/one.html")
        return found

    monkeypatch.setattr(Bucket, "list", list_and_lose)
    assert fetch_files(machine("b"), bucket) == 1
    assert [path.name for path in (machine("b") / "reports").iterdir()] == ["two.html"]


def test_machines_that_export_at_once_end_with_the_files_of_the_later_one(machine, bucket, monkeypatch):
    first, second = machine("a"), machine("b")
    for number in (0, 1):
        write(first, f"events/demo/{number}.parquet", "first")
    write(second, "events/demo/0.parquet", "second")
    send = Bucket.send

    def send_and_meet(self, path, name):
        send(self, path, name)
        if {f"events/demo/{number}.parquet" for number in (0, 1)} <= bucket_server.objects(bucket.url).keys():
            monkeypatch.setattr(Bucket, "send", send)
            send_files(second, bucket)

    monkeypatch.setattr(Bucket, "send", send_and_meet)
    assert send_files(first, bucket) == 2
    assert bucket_server.objects(bucket.url) == {"events/demo/0.parquet": b"second"}
    assert send_files(first, bucket) == send_files(second, bucket) == 0


def test_events_are_sent_and_those_of_the_export_before_go(machine, bucket):
    home = machine("a")
    for name in ("a/events/1.aedat4", "a/events/2.aedat4", "b/events/1.aedat4"):
        write(home, f"events/{name}", name)
    assert send_files(home, bucket) == 3
    (home / "events/a/events/2.aedat4").unlink()
    write(home, "events/a/events/1.aedat4", "of another export")
    send_files(home, bucket)
    names = [name for name in bucket_server.objects(bucket.url) if name.startswith("events/")]
    assert names == ["events/a/events/1.aedat4", "events/b/events/1.aedat4"]
    assert fetch_files(machine("b"), bucket) == 0, "they may be large"


@pytest.fixture
def experiments():
    return lambda seed: load_preset(Experiment, PRESETS, "smoke", [f"seed={seed}"])


def test_openings_of_machines_side_by_side_are_all_counted(machine, bucket, experiments):
    homes = [machine("a"), machine("b")]
    asked = [experiments(seed) for seed in range(6)]
    with ThreadPoolExecutor(6) as threads:
        list(threads.map(lambda number: note_opening(homes[number % 2], "d", asked[number % 6]), range(12)))
    assert note_opening(homes[0], "d", asked[0]) == 6
    ledger = [json.loads(text) for name, text in bucket_server.objects(bucket.url).items() if "test_sets/d/" in name]
    assert len({line["options"] for line in ledger}) == len(ledger) == 6
    assert note_opening(homes[0], "e", asked[0]) == 1


def version(number):
    frames = StoredArtefact(stage="sample", key="0" * 32, digest="0" * 64, rows=2)
    return Version(
        experiment="pose", number=number, seed=number, made="2026-01-01T00:00:00Z", synthetic=frames, made_from=(),
        scored_in=(), scores={}, gates=Gates(), checks=(),
    )  # fmt: skip


def test_versions_of_two_machines_are_numbered_one_after_another(machine, bucket):
    folders = [published_folder(machine(name), "pose") for name in "ab"]
    for expected, folder in enumerate([folders[0], folders[1], folders[1], folders[0]], start=1):
        with claimed(folder) as claim:
            assert claim.number == expected
            claim.finish(version(claim.number))
    fetch_files(machine("b"), bucket)
    for folder in folders:
        assert [found.number for found in read_versions(folder)] == [1, 2, 3, 4] and read_latest(folder).number == 4
    names = [name for name in bucket_server.objects(bucket.url) if name.startswith("published/")]
    assert sorted(names) == [f"published/pose/{name}.json" for name in ("latest", "v0001", "v0002", "v0003", "v0004")]


def test_only_one_machine_makes_a_version_at_a_time(machine):
    folders = [published_folder(machine(name), "pose") for name in "ab"]
    busy = pytest.raises(BlockingIOError, match=r"is making a version of pose; ask again when it has ended")
    with claimed(folders[0]), busy, claimed(folders[1]):
        pass
    with claimed(folders[1]) as claim:
        assert claim.number == 1


def test_a_version_that_was_begun_and_made_elsewhere_is_not_made_again(machine):
    first, second = (published_folder(machine(name), "pose") for name in "ab")
    with claimed(first) as claim:
        assert claim.number == 1  # and the run is killed
    with claimed(second) as claim:
        claim.finish(version(claim.number))
    for number in (2, 3):
        with claimed(second) as claim:
            assert claim.number == number
            claim.finish(version(number))
    with claimed(first) as claim:
        assert claim.version == version(1)
        claim.finish(claim.version)
    assert read_latest(first).number == 3, "the claim of an old version does not bring it back"
    with claimed(first) as claim:
        assert claim.number == 4
