"""The deployments of prefect.yaml, served as docs/operations.md says: a server, a pool and a worker on loopback."""

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml
from flow_scripts import REPOSITORY, digests

from ctlev_core.processes import die_with_parent
from tasks.store import Store

PREFECT = [str(Path(sys.executable).with_name("prefect"))]
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


@dataclass
class Service:
    """A server, and a worker that serves the pool; both end with this process."""

    home: Path
    url: str
    environment: dict[str, str]
    worker: subprocess.Popen | None = None

    def api(self, path, body=None):
        """What the server answers."""
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(f"{self.url}/{path}", data, {"Content-Type": "application/json"})
        with urllib.request.urlopen(request, timeout=60) as response:
            return json.load(response)

    def prefect(self, *arguments, timeout=240):
        """Run a command of Prefect's, from the repository."""
        command = [*PREFECT, "--no-prompt", *arguments]
        return subprocess.run(
            command, cwd=REPOSITORY, env=self.environment, capture_output=True, text=True, timeout=timeout
        )

    def start_worker(self):
        """A worker in a session of its own, so that it can be ended with what it started."""
        with (self.home / "worker.log").open("ab") as log:
            self.worker = subprocess.Popen(
                [*PREFECT, "worker", "start", "--pool", "ctlev"],
                cwd=self.home,
                env=self.environment,
                stdout=log,
                stderr=log,
                start_new_session=True,
                preexec_fn=die_with_parent,
            )

    def start_run(self, deployment, home, *overrides):
        """Ask for a run as a user does; its id."""
        parameters = {"preset": "smoke", "overrides": list(overrides), "home": str(home)}
        asked = [part for name, value in parameters.items() for part in ("-p", f"{name}={json.dumps(value)}")]
        finished = self.prefect("deployment", "run", f"{deployment}/default", *asked)
        assert finished.returncode == 0, finished.stderr + finished.stdout
        return re.findall(r"UUID: ([0-9a-f-]{36})", finished.stdout)[0]

    def state(self, run, *, until, timeout=400):
        """The state of a run, once its type is one of `until`."""
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            state = self.api(f"flow_runs/{run}")["state"]
            if state["type"] in until:
                return state
            time.sleep(0.5)
        raise AssertionError(f"{state}\n{(self.home / 'worker.log').read_text()[-4000:]}")


ENDED = {"COMPLETED", "FAILED", "CRASHED", "CANCELLED"}


def end(process):
    """End a process and all of its session."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    """Every deployment, ready to run."""
    home = tmp_path_factory.mktemp("service")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")} | {
        "CTLEV_HOME": str(home),
        "PREFECT_HOME": str(home / "prefect"),
        "PREFECT_API_URL": f"http://127.0.0.1:{port}/api",
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "PREFECT_WORKER_QUERY_SECONDS": "2",
        "DO_NOT_TRACK": "1",
        "NO_COLOR": "1",
    }
    made = Service(home, environment["PREFECT_API_URL"], environment)
    with (home / "server.log").open("wb") as log:
        server = subprocess.Popen(
            [*PREFECT, "server", "start", "--host", "127.0.0.1", "--port", str(port), "--no-ui"],
            cwd=home,
            env=environment,
            stdout=log,
            stderr=log,
            start_new_session=True,
            preexec_fn=die_with_parent,
        )
    try:
        deadline = time.monotonic() + 300
        while True:
            try:
                made.api("health")
                break
            except (urllib.error.URLError, OSError):
                assert server.poll() is None and time.monotonic() < deadline, (home / "server.log").read_text()
                time.sleep(0.2)
        made.start_worker()  # makes the pool where there is none
        for command in (("work-pool", "create", "ctlev", "--type", "process", "--overwrite"), ("deploy", "--all")):
            finished = made.prefect(*command)
            assert finished.returncode == 0, finished.stdout + finished.stderr
        yield made
    finally:
        if made.worker is not None:
            end(made.worker)
        end(server)


def test_deployments_say_what_they_take_and_regenerate_never_overlaps(service):
    found = {name: service.api(f"deployments/name/{name}/default") for name in SCRIPTS}
    for name, deployment in found.items():
        parameters = deployment["parameter_openapi_schema"]["properties"]
        expected = {"preset": "string", "overrides": "array", "home": None}
        if name == "compare":
            expected = {"run_a": "string", "run_b": "string", "home": None}
        assert {name: value.get("type") for name, value in parameters.items()} == expected
        assert all(value["description"] for value in parameters.values())
        assert deployment["enforce_parameter_schema"] and deployment["work_pool_name"] == "ctlev"
        assert bool(deployment["schedules"]) == (name == "regenerate")
    scheduled = found["regenerate"]
    (schedule,) = scheduled["schedules"]
    assert not schedule["active"] and schedule["schedule"]["cron"] == "0 3 * * 0"
    assert scheduled["global_concurrency_limit"]["limit"] == 1
    assert scheduled["concurrency_options"]["collision_strategy"] == "CANCEL_NEW"


def test_a_deployed_run_makes_what_the_script_makes_and_shows_its_plan(service, tmp_path):
    run = service.start_run("prepare-dataset", tmp_path / "deployed", "num_synthetic=3")
    options = ["--preset", "smoke", "--set", "num_synthetic=3", "--home", str(tmp_path / "script")]
    script = subprocess.run(
        [sys.executable, str(REPOSITORY / "flows" / "prepare_dataset.py"), *options],
        env=service.environment,
        capture_output=True,
        text=True,
        timeout=400,
    )
    assert script.returncode == 0, script.stderr
    state = service.state(run, until=ENDED)
    assert state["type"] == "COMPLETED", state
    stages = ("ingest", "encode", "condition_frames", "condition_samples")
    made = digests(tmp_path / "deployed", stages)
    assert made == digests(tmp_path / "script", stages) and {name.partition("/")[0] for name in made} == set(stages)
    assert (tmp_path / "deployed" / "reports" / "smoke_conditions.html").is_file()
    assert not (service.home / "artefacts").exists()
    (plan,) = service.api("artifacts/filter", {"artifacts": {"flow_run_id": {"any_": [run]}}})
    assert {row["plan"] for row in json.loads(plan["data"])} == {"to run"}


def test_wrong_types_are_refused_before_anything_runs(service):
    finished = service.prefect("deployment", "run", "prepare-dataset/default", "-p", "overrides=5")
    assert finished.returncode != 0
    assert "overrides" in finished.stdout + finished.stderr


@pytest.mark.slow
def test_a_run_whose_worker_is_killed_goes_on_with_another(service, tmp_path):
    first = service.start_run("prepare-dataset", tmp_path)
    deadline = time.monotonic() + 400
    while not digests(tmp_path, ("ingest",)) and time.monotonic() < deadline:
        time.sleep(0.1)
    before = digests(tmp_path)
    assert before
    end(service.worker)
    service.start_worker()
    second = service.start_run("prepare-dataset", tmp_path)
    state = service.state(second, until=ENDED)
    assert first != second and state["type"] == "COMPLETED", state
    after = digests(tmp_path)
    assert before.items() <= after.items() and len(after) == 5
    for name in after:
        Store(tmp_path).check(tmp_path / "artefacts" / name)
    (plan,) = service.api("artifacts/filter", {"artifacts": {"flow_run_id": {"any_": [second]}}})
    cached = {row["stage"].partition(":")[0] for row in json.loads(plan["data"]) if row["plan"] == "cached"}
    assert "ingest" in cached


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_whole_experiment_is_completed_although_its_worker_was_killed(service, tmp_path):
    first = service.start_run("full-experiment", tmp_path)
    deadline = time.monotonic() + 800
    while not digests(tmp_path, ("encode",)) and time.monotonic() < deadline:
        time.sleep(0.1)
    before = digests(tmp_path)
    assert before
    end(service.worker)
    service.start_worker()
    second = service.start_run("full-experiment", tmp_path)
    state = service.state(second, until=ENDED, timeout=900)
    assert first != second and state["type"] == "COMPLETED", state
    after = digests(tmp_path)
    assert before.items() <= after.items() and (tmp_path / "reports" / "smoke.html").is_file()
    (plan,) = service.api(
        "artifacts/filter", {"artifacts": {"flow_run_id": {"any_": [second]}, "key": {"any_": ["plan"]}}}
    )
    planned = json.loads(plan["data"])
    assert {row["key"] for row in planned} == {name.partition("/")[2] for name in after}
    cached = {row["key"] for row in planned if row["plan"] == "cached"}
    assert {name.partition("/")[2] for name in before} <= cached


@pytest.mark.slow
def test_a_run_that_would_overlap_is_cancelled_and_says_why(service, tmp_path):
    first = service.start_run("regenerate", tmp_path)
    service.state(first, until={"PENDING", "RUNNING"})
    second = service.start_run("regenerate", tmp_path)
    state = service.state(second, until=ENDED)
    assert state["type"] == "CANCELLED" and "concurrency limit" in state["message"]
    assert service.prefect("flow-run", "cancel", first).returncode == 0
    assert service.state(first, until=ENDED)["type"] == "CANCELLED"
