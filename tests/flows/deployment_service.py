"""A Prefect server, a pool and a worker on loopback, as docs/operations.md says how to start them."""

from __future__ import annotations

import base64
import contextlib
import http
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
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from flow_scripts import REPOSITORY

from ctlev_core.processes import die_with_parent

DEPLOYMENTS = {
    (flow := item["entrypoint"].rpartition(".")[2].replace("_", "-")): f"{flow}/{item['name']}"
    for item in yaml.safe_load((REPOSITORY / "prefect.yaml").read_text())["deployments"]
}
"""`FLOW/DEPLOYMENT` by the flow's name."""
PREFECT = [str(Path(sys.executable).with_name("prefect"))]
ENDED = {"COMPLETED", "FAILED", "CRASHED", "CANCELLED"}
PASSWORD = "ctlev:a password of the tests"
TIMEOUT_S = 900.0
"""For what takes seconds to a minute where nothing else runs."""


@dataclass
class Service:
    """A server, and a worker that serves the pool; both end with this process."""

    home: Path
    url: str
    environment: dict[str, str]
    worker: subprocess.Popen | None = None

    def api(self, path: str, body: Any = None, method: str | None = None) -> Any:
        """What the server answers; a question that changes nothing is asked again where no answer comes.

        A server on SQLite can be silent for the minute in which one of its writers waits for a lock, and then answers
        503, having changed nothing. Prefect's own client is as patient, and asks again.
        """
        data = None if body is None else json.dumps(body).encode()
        known = base64.b64encode(self.environment["PREFECT_API_AUTH_STRING"].encode()).decode()
        headers = {"Content-Type": "application/json", "Authorization": f"Basic {known}"}
        request = urllib.request.Request(f"{self.url}/{path}", data, headers, method=method)
        asks = request.get_method() == "GET" or path.endswith("/filter")
        deadline = time.monotonic() + TIMEOUT_S
        while True:
            try:
                with urllib.request.urlopen(request, timeout=60 if asks else TIMEOUT_S) as response:
                    return json.loads(response.read() or b"null")
            except TimeoutError:
                if not asks or time.monotonic() > deadline:
                    raise
            except urllib.error.HTTPError as error:
                if error.code != http.HTTPStatus.SERVICE_UNAVAILABLE or time.monotonic() > deadline:
                    raise
                time.sleep(1)

    def prefect(self, *arguments: str, timeout: float = TIMEOUT_S) -> subprocess.CompletedProcess[str]:
        """Run a command of Prefect's, from the repository."""
        command = [*PREFECT, "--no-prompt", *arguments]
        return subprocess.run(
            command, cwd=REPOSITORY, env=self.environment, capture_output=True, text=True, timeout=timeout
        )

    def start_worker(self) -> None:
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

    def replace_worker(self) -> None:
        """`kill -9` the worker with the runs it serves, and start another."""
        assert self.worker is not None
        end(self.worker)
        self.start_worker()

    def start_run(self, deployment: str, home: Path, *overrides: str) -> str:
        """Ask for a run as a user does; its id."""
        parameters = smoke_parameters(home, overrides)
        asked = [part for name, value in parameters.items() for part in ("-p", f"{name}={json.dumps(value)}")]
        finished = self.prefect("deployment", "run", DEPLOYMENTS[deployment], *asked)
        assert finished.returncode == 0, finished.stderr + finished.stdout
        return re.findall(r"UUID: ([0-9a-f-]{36})", finished.stdout)[0]

    def state(self, run: str, *, until: set[str]) -> dict[str, Any]:
        """The state of a run, once its type is one of `until`."""
        deadline = time.monotonic() + TIMEOUT_S
        while (state := self.api(f"flow_runs/{run}")["state"])["type"] not in until:
            assert time.monotonic() < deadline, f"{state}\n{self.log('worker')}"
            time.sleep(0.5)
        return state

    def lose_worker_once(self, happened: Callable[[], object], run: str) -> None:
        """Kill the worker as soon as something has happened, in the middle of a run; then there is a new worker."""
        deadline = time.monotonic() + TIMEOUT_S
        while not happened():
            state = self.api(f"flow_runs/{run}")["state"]
            assert state["type"] not in ENDED and time.monotonic() < deadline, f"{state}\n{self.log('worker')}"
            time.sleep(0.2)
        self.replace_worker()

    def log(self, name: str) -> str:
        """The end of what the server or the workers said."""
        return (self.home / f"{name}.log").read_text()[-4000:]

    def artifacts(self, run: str) -> dict[str, dict[str, Any]]:
        """What a run shows, by key."""
        found = self.api("artifacts/filter", {"artifacts": {"flow_run_id": {"any_": [run]}}, "limit": 200})
        return {artifact["key"]: artifact for artifact in found}

    def logged(self, run: str, pattern: str) -> str:
        """The first message of a run's log that begins so. Prefect sends logs in the background, after the state."""
        deadline = time.monotonic() + 120
        while True:
            found = self.api("logs/filter", {"logs": {"flow_run_id": {"any_": [run]}}, "limit": 200})
            messages = [log["message"] for log in found]
            for message in messages:
                if re.match(pattern, message):
                    return message
            assert time.monotonic() < deadline, messages
            time.sleep(0.5)

    def plan(self, run: str) -> list[dict[str, str]]:
        """What a run said it would do."""
        return json.loads(self.artifacts(run)["plan"]["data"])


def smoke_parameters(home: Path, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Of a deployment, to run the smallest experiment in a home of its own."""
    return {"preset": "smoke", "overrides": list(overrides), "home": str(home)}


def end(process: subprocess.Popen) -> None:
    """End a process and all of its session."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


@contextlib.contextmanager
def serving(home: Path) -> Iterator[Service]:
    """Every deployment, ready to run."""
    with server(home) as made:
        try:
            made.start_worker()  # makes the pool where there is none
            for command in (("work-pool", "create", "ctlev", "--type", "process", "--overwrite"), ("deploy", "--all")):
                finished = made.prefect(*command)
                assert finished.returncode == 0, finished.stdout + finished.stderr
            yield made
        finally:
            if made.worker is not None:
                end(made.worker)


@contextlib.contextmanager
def server(home: Path) -> Iterator[Service]:
    """A server alone."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")} | {
        "CTLEV_HOME": str(home),
        "PREFECT_HOME": str(home / "prefect"),
        "PREFECT_API_URL": f"http://127.0.0.1:{port}/api",
        "PREFECT_API_AUTH_STRING": PASSWORD,
        "PREFECT_SERVER_API_AUTH_STRING": PASSWORD,
        "PREFECT_SERVER_CORS_ALLOWED_ORIGINS": f"http://127.0.0.1:{port}",
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        # A new schedule is seen when the scheduler next looks, by itself once a minute.
        "PREFECT_SERVER_SERVICES_SCHEDULER_LOOP_SECONDS": "2",
        "PREFECT_WORKER_QUERY_SECONDS": "2",
        "DO_NOT_TRACK": "1",
        "NO_COLOR": "1",
    }
    made = Service(home, environment["PREFECT_API_URL"], environment)
    with (home / "server.log").open("wb") as log:
        process = subprocess.Popen(
            [*PREFECT, "server", "start", "--host", "127.0.0.1", "--port", str(port), "--no-ui"],
            cwd=home,
            env=environment,
            stdout=log,
            stderr=log,
            start_new_session=True,
            preexec_fn=die_with_parent,
        )
    try:
        deadline = time.monotonic() + TIMEOUT_S
        while True:
            try:
                made.api("health")
                break
            except (urllib.error.URLError, OSError):
                assert process.poll() is None and time.monotonic() < deadline, (home / "server.log").read_text()
                time.sleep(0.2)
        yield made
    finally:
        end(process)
