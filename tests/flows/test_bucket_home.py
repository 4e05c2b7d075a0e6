"""Flows on machines that share a home in a bucket; a machine is a cache of its own."""

import re
import shutil

import bucket_server
import pytest
from flow_scripts import digests, plan_script, run_script_here, script

from data_contracts.home_folder import home_folder


@pytest.fixture
def machine(bucket_url, tmp_path, monkeypatch):
    """Makes the processes that are started from now on those of the machine of a name; returns its cache."""

    def start(name):
        monkeypatch.setenv("CTLEV_CACHE", str(tmp_path / name))
        return home_folder(bucket_url)

    return start


def records(home):
    return {path.parent.name: path.read_bytes() for path in (home / "artefacts").glob("*/*/run.json")}


@pytest.mark.slow
def test_two_machines_at_once_make_each_artefact_once_and_a_third_none(machine, bucket_url, tmp_path):
    asked = ("prepare_dataset", "--preset", "smoke", "--home", bucket_url)
    caches, running = [], []
    for name in "ab":
        caches.append(machine(name))
        running.append(script(*asked, home=tmp_path / "elsewhere"))
    for process in running:
        output, errors = process.communicate(timeout=500)
        assert process.returncode == 0, output + errors
    made = records(caches[0])
    # When it was made, and for how long, is in a record: the same bytes are of one making.
    assert len(made) > 5 and records(caches[1]) == made
    third = machine("c")
    planned = plan_script(*asked, "--dry-run", home=tmp_path / "elsewhere")
    assert planned.status == 0 and {state for state, _ in planned.plan.values()} == {"cached"}
    assert not (third / "artefacts").exists(), "a plan fetches nothing"
    finished = run_script_here(*asked, home=tmp_path / "elsewhere")
    assert finished.status == 0, finished.errors
    stages = len(planned.plan)
    assert f"{stages} stages, {stages} of them cached" in finished.output
    assert records(third) == made
    for path in (caches[0] / "artefacts").rglob("*"):
        assert path.is_dir() or (third / path.relative_to(caches[0])).read_bytes() == path.read_bytes()


@pytest.mark.release
def test_a_whole_experiment_is_found_by_another_machine(machine, bucket_url, smoke_home, tmp_path):
    first = machine("a")
    shutil.copytree(smoke_home / "artefacts", first / "artefacts")
    asked = ("full_experiment", "--preset", "smoke", "--home", bucket_url)
    sent = run_script_here(*asked, home=tmp_path / "elsewhere")
    assert sent.status == 0, sent.errors
    second = machine("b")
    finished = run_script_here(*asked, home=tmp_path / "elsewhere")
    assert finished.status == 0, finished.errors
    stages, cached = map(int, re.search(r"^(\d+) stages, (\d+) of them cached", finished.output, re.MULTILINE).groups())
    assert stages == cached > 40
    assert digests(second) == digests(smoke_home)
    names = set(bucket_server.objects(bucket_url))
    assert {"reports/smoke.html", "reports/smoke/provenance.json"} <= names
    shown = run_script_here("compare", "smoke", "smoke", "--home", bucket_url, home=tmp_path / "elsewhere")
    assert shown.status == 0, shown.errors


@pytest.mark.parametrize("name", ["full_experiment", "verify", "prune"])
def test_a_bucket_that_is_not_there_is_said_before_anything_runs(s3_server, monkeypatch, tmp_path, name):
    monkeypatch.setenv("CTLEV_CACHE", str(tmp_path / "a"))
    finished = plan_script(name, "--home", "s3://no-such-bucket/x", home=tmp_path / "elsewhere")
    assert finished.status == 2
    assert finished.errors.startswith("error: s3://no-such-bucket/x: there is no such bucket; make it, or correct")
    refused = plan_script(name, "--home", "http://host/x", home=tmp_path / "elsewhere")
    assert refused.status == 2 and "expected a folder, or a bucket at s3://" in refused.errors
