"""The deployments of prefect.yaml, served as docs/operations.md says: a server, a pool and a worker on loopback."""

import datetime
import http.server
import inspect
import itertools
import json
import queue
import re
import subprocess
import sys
import threading
import time

import pytest
import yaml
from deployment_service import DEPLOYMENTS, ENDED, TIMEOUT_S, serving, smoke_parameters
from flow_scripts import REPOSITORY, digests

from data_contracts.published import published_folder, read_latest, read_versions
from flows import deployments
from flows.command_line import load_experiment
from flows.realism_chain import load_realism_chain
from flows.regenerate import load_regeneration
from flows.speed_vs_error import load_speed_vs_error
from flows.studies import load_study
from flows.synthesize import load_synthesis
from tasks.store import Store

SCRIPTS = {
    name: path
    for path in (REPOSITORY / "flows").glob("*.py")
    for name in re.findall(r'^@flow\(name="([a-z-]+)"\)$', path.read_text(), re.MULTILINE)
}


def test_every_flow_script_has_a_deployment_with_a_description_and_tags():
    listed = yaml.safe_load((REPOSITORY / "prefect.yaml").read_text())["deployments"]
    assert sorted(item["entrypoint"] for item in listed) == sorted(
        f"flows.deployments.{path.stem}" for path in SCRIPTS.values()
    )
    assert all(item["description"] and item["tags"] and item["work_pool"] == {"name": "ctlev"} for item in listed)


def test_defaults_are_presets_that_load():
    loaders = {
        "full_experiment": load_study,
        "speed_vs_error": load_speed_vs_error,
        "realism_chain": load_realism_chain,
        "synthesize": load_synthesis,
        "regenerate": load_regeneration,
        "evaluate": load_experiment,
    }
    for name, load in loaders.items():
        preset = inspect.signature(getattr(deployments, name).fn).parameters["preset"].default
        assert load(preset, []), name


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    """Every deployment, ready to run."""
    with serving(tmp_path_factory.mktemp("service")) as made:
        yield made


@pytest.mark.slow
def test_deployments_say_what_they_take_and_regenerate_never_overlaps(service):
    found = {name: service.api(f"deployments/name/{DEPLOYMENTS[name]}") for name in SCRIPTS}
    for name, deployment in found.items():
        parameters = deployment["parameter_openapi_schema"]["properties"]
        expected = {"preset": None, "overrides": "array", "home": None}
        if name == "compare":
            expected = {"run_a": "string", "run_b": "string", "home": None}
        assert {name: value.get("type") for name, value in parameters.items()} == expected
        if name != "compare":
            bundled, other = parameters["preset"]["anyOf"]
            assert parameters["preset"]["default"] in bundled["enum"] and other == {"type": "string"}
            assert DEPLOYMENTS[name] == f"{name}/{parameters['preset']['default']}"
        assert all(value["description"] for value in parameters.values())
        assert deployment["enforce_parameter_schema"] and deployment["work_pool_name"] == "ctlev"
        assert bool(deployment["schedules"]) == (name == "regenerate")
    scheduled = found["regenerate"]
    (schedule,) = scheduled["schedules"]
    assert not schedule["active"] and schedule["schedule"]["cron"] == "0 3 * * 0"
    assert scheduled["global_concurrency_limit"]["limit"] == 1
    assert scheduled["concurrency_options"]["collision_strategy"] == "CANCEL_NEW"


@pytest.mark.slow
def test_a_deployed_run_makes_what_the_script_makes_and_shows_its_plan(service, tmp_path):
    run = service.start_run("prepare-dataset", tmp_path / "deployed", "num_synthetic=3")
    options = ["--preset", "smoke", "--set", "num_synthetic=3", "--home", str(tmp_path / "script")]
    script = subprocess.run(
        [sys.executable, str(REPOSITORY / "flows" / "prepare_dataset.py"), *options],
        env=service.environment,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )
    assert script.returncode == 0, script.stderr
    state = service.state(run, until=ENDED)
    assert state["type"] == "COMPLETED", state
    stages = ("ingest", "encode", "condition_frames", "condition_samples")
    made = digests(tmp_path / "deployed", stages)
    assert made == digests(tmp_path / "script", stages) and {name.partition("/")[0] for name in made} == set(stages)
    assert (tmp_path / "deployed" / "reports" / "smoke_conditions.html").is_file()
    assert not (service.home / "artefacts").exists()
    assert {row["plan"] for row in service.plan(run)} == {"to run"}
    shown = service.artifacts(run)
    pictures = [key for key, artifact in shown.items() if "data:image/png;base64," in str(artifact["data"])]
    assert any(key.startswith("encode") for key in pictures), sorted(shown)
    service.logged(run, r"^encode.*: \d+ rows in [\d.]+ s, key ")


@pytest.mark.slow
def test_wrong_types_are_refused_before_anything_runs(service):
    finished = service.prefect("deployment", "run", DEPLOYMENTS["prepare-dataset"], "-p", "overrides=5")
    assert finished.returncode != 0
    assert "overrides" in finished.stdout + finished.stderr


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_run_whose_worker_is_killed_goes_on_with_another(service, tmp_path):
    first = service.start_run("prepare-dataset", tmp_path)
    service.lose_worker_once(lambda: digests(tmp_path, ("ingest",)), first)
    before = digests(tmp_path)
    second = service.start_run("prepare-dataset", tmp_path)
    state = service.state(second, until=ENDED)
    assert state["type"] == "COMPLETED", state
    after = digests(tmp_path)
    planned = service.plan(second)
    assert before.items() <= after.items()
    assert {row["key"] for row in planned} == {name.partition("/")[2] for name in after}
    for name in after:
        Store(tmp_path).check(tmp_path / "artefacts" / name)
    cached = {row["stage"].partition(":")[0] for row in planned if row["plan"] == "cached"}
    assert "ingest" in cached


@pytest.mark.release
@pytest.mark.timeout(1800)
def test_a_whole_experiment_is_completed_although_its_worker_was_killed(service, tmp_path):
    first = service.start_run("full-experiment", tmp_path)
    service.lose_worker_once(lambda: digests(tmp_path, ("encode",)), first)
    before = digests(tmp_path)
    second = service.start_run("full-experiment", tmp_path)
    state = service.state(second, until=ENDED)
    assert state["type"] == "COMPLETED", state
    after = digests(tmp_path)
    assert before.items() <= after.items() and (tmp_path / "reports" / "smoke.html").is_file()
    planned = service.plan(second)
    assert {row["key"] for row in planned} == {name.partition("/")[2] for name in after}
    cached = {row["key"] for row in planned if row["plan"] == "cached"}
    assert {name.partition("/")[2] for name in before} <= cached


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_run_that_would_overlap_is_cancelled_and_says_why(service, tmp_path):
    first = service.start_run("regenerate", tmp_path)
    service.state(first, until={"PENDING", "RUNNING"})
    second = service.start_run("regenerate", tmp_path)
    state = service.state(second, until=ENDED)
    assert state["type"] == "CANCELLED" and "concurrency limit" in state["message"]
    assert service.prefect("flow-run", "cancel", first).returncode == 0
    assert service.state(first, until=ENDED)["type"] == "CANCELLED"


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_version_that_fails_a_gate_calls_the_webhook_of_the_docs(service, tmp_path):
    heard: queue.Queue[str] = queue.Queue()

    class Listener(http.server.BaseHTTPRequestHandler):
        def do_POST(self):
            heard.put(self.rfile.read(int(self.headers["Content-Length"])).decode())
            self.send_response(200)
            self.end_headers()

        def log_message(self, *told):
            pass

    page = (REPOSITORY / "docs" / "operations.md").read_text()
    (code,) = re.findall(r"```python\n(.*?Automation.*?)```", page, re.DOTALL)
    with http.server.HTTPServer(("127.0.0.1", 0), Listener) as listener:
        threading.Thread(target=listener.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{listener.server_address[1]}/gate"
        assert "http://127.0.0.1:9000/gate" in code
        made = subprocess.run(
            [sys.executable, "-c", code.replace("http://127.0.0.1:9000/gate", url)],
            env=service.environment, capture_output=True, text=True, timeout=TIMEOUT_S,
        )  # fmt: skip
        assert made.returncode == 0, made.stderr
        run = service.start_run("regenerate", tmp_path, *QUICK, "gates.max_distance_ratio=0.001")
        assert service.state(run, until=ENDED)["name"] == "Rejected"
        told = heard.get(timeout=120)
        listener.shutdown()
    assert service.api(f"flow_runs/{run}")["name"] in told and "max_distance_ratio" in told


QUICK = (
    "num_synthetic=3", "baselines={}", "oracle=null", "generator.options.num_steps=2",
    "sampling.num_inference_steps=2", "downstream.options.num_steps=2", "feature_extractor.options.num_steps=2",
    # Nothing learnt in two steps is good.
    *(f"gates.{gate}=null" for gate in ("max_distance_ratio", "max_label_error_ratio", "max_rejected_share")),
    "gates.max_memorised_share=1",
)  # fmt: skip


def schedule_once(service, deployment, home, times=1, after_s=30):
    """Schedules that each fire once, all at the same moment; the runs that Prefect's scheduler has made of them.

    A schedule whose moment has passed before the scheduler looks never becomes a run, and nobody says so: then another
    is made.
    """
    before = auto_scheduled(service, deployment)
    for _ in range(3):
        moment, deadline = datetime.datetime.now(datetime.UTC), time.monotonic() + min(after_s, 300)
        rule = f"DTSTART:{moment + datetime.timedelta(seconds=after_s):%Y%m%dT%H%M%SZ}\nRRULE:FREQ=DAILY;COUNT=1"
        schedule = {"schedule": {"rrule": rule, "timezone": "UTC"}, "active": True}
        schedule["parameters"] = smoke_parameters(home, QUICK)
        service.api(f"deployments/{deployment}/schedules", [schedule] * times)
        while time.monotonic() < deadline:
            if len(made := auto_scheduled(service, deployment) - before) >= times:
                return made
            time.sleep(0.5)
    raise AssertionError(f"the scheduler looked too late\n{service.log('server')}")


def auto_scheduled(service, deployment):
    """The runs that schedules asked for."""
    asked = {"deployments": {"id": {"any_": [deployment]}}}
    return {run["id"] for run in service.api("flow_runs/filter", asked) if run["auto_scheduled"]}


def ended(service, runs):
    """Runs once all have ended, in order of their start."""
    for run in runs:
        service.state(run, until=ENDED)
    return sorted((service.api(f"flow_runs/{run}") for run in runs), key=lambda run: run["start_time"] or "")


@pytest.mark.slow
def test_a_schedule_becomes_a_run(service, tmp_path):
    deployment = service.api(f"deployments/name/{DEPLOYMENTS['prepare-dataset']}")["id"]
    (made,) = schedule_once(service, deployment, tmp_path, after_s=86_400)
    run = service.api(f"flow_runs/{made}")
    assert run["state"]["type"] == "SCHEDULED" and run["parameters"]["home"] == str(tmp_path)
    service.api(f"flow_runs/{made}", method="DELETE")


@pytest.mark.release
@pytest.mark.timeout(2400)
def test_scheduled_regenerations_do_not_overlap_and_a_killed_one_is_gone_on_with(service, tmp_path):
    """Two schedules fire at the same moment, a third later; the worker of a fourth run is killed while it samples."""
    deployment = service.api(f"deployments/name/{DEPLOYMENTS['regenerate']}")["id"]
    folder = published_folder(tmp_path, "smoke")
    runs = ended(service, schedule_once(service, deployment, tmp_path, times=2))
    ran = [run for run in runs if run["state"]["type"] == "COMPLETED"]
    refused = [run for run in runs if run["state"]["type"] == "CANCELLED"]
    assert len(ran) + len(refused) == 2 and ran, [run["state"] for run in runs]
    assert all("concurrency limit" in run["state"]["message"] and run["run_count"] == 0 for run in refused), refused

    third = ended(service, schedule_once(service, deployment, tmp_path))
    assert [run["state"]["type"] for run in third] == ["COMPLETED"], third
    ran += third
    times = [(parsed(run["start_time"]), parsed(run["end_time"])) for run in ran]
    assert all(begins < ends for begins, ends in times)
    assert all(first[1] <= second[0] for first, second in itertools.pairwise(times)), "one after the other"
    versions = read_versions(folder)
    assert [version.number for version in versions] == list(range(1, len(ran) + 1))
    assert len({version.seed for version in versions}) == len(versions)

    number = len(versions) + 1
    killed = service.start_run("regenerate", tmp_path, *QUICK)
    sampled = digests(tmp_path, ("sample",))
    claimed = folder / "claimed.json"
    service.lose_worker_once(lambda: claimed.exists() and digests(tmp_path, ("sample",)) != sampled, killed)
    assert json.loads(claimed.read_text())["number"] == number
    latest = read_latest(folder)
    assert latest is not None and latest.number == number - 1, "the version that was begun is not yet the latest"
    begun = digests(tmp_path)
    # Nobody is left to say so, and the dead run keeps its place for the five minutes of its lease otherwise.
    service.api(f"flow_runs/{killed}/set_state", {"state": {"type": "CRASHED"}, "force": True})
    state = service.state(service.start_run("regenerate", tmp_path, *QUICK), until=ENDED)
    assert (state["type"], state["name"]) == ("COMPLETED", "Published"), state
    latest = read_latest(folder)
    assert latest is not None and latest.number == number and not claimed.exists()
    after = digests(tmp_path)
    assert begun.items() <= after.items() and digests(tmp_path, ("sample",)).keys() == {
        name for name in begun if name.startswith("sample/")
    }, "what the killed run had sampled is what is published"


def parsed(moment):
    return datetime.datetime.fromisoformat(moment)
