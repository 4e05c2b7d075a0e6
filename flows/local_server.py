"""Prefect without a server of the user's own: one private server for the life of one script.

Prefect would start such a server itself, but only when the first flow is called, with a 20 s limit that a busy
machine exceeds, and it outlives a killed script. Here it starts before anything heavy is imported, so that its start-up
overlaps ours, and it dies with the script, whatever ends the script.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

from ctlev_core.processes import die_with_parent, module_environment

START_TIMEOUT_S = 300.0
_QUIET = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_TELEMETRY_ENABLE_RESOURCE_METRICS": "false",
    "PREFECT_CLI_PROMPT": "false",
    "PREFECT_LOGGING_TO_API_ENABLED": "false",
}
_SERVER = {
    "PREFECT_UI_ENABLED": "0",
    "PREFECT__SERVER_EPHEMERAL": "1",
    # One at a time, as Prefect does it, few task runs of a quick flow are recorded before the server ends with it.
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_BATCH_SIZE": "50",
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_FLUSH_INTERVAL": "1",
}
_server: subprocess.Popen[bytes] | None = None
_url = ""
_log = Path()


def configure(home: Path, *, verbose: bool) -> None:
    """Point Prefect at `home` and keep it quiet. Must run before Prefect is imported; what the user set stays."""
    with contextlib.suppress(OSError):  # `main` says clearly that the home cannot be written
        (home / "prefect").mkdir(parents=True, exist_ok=True)
    settings = {"PREFECT_HOME": str(home / "prefect"), "PREFECT_LOGGING_LEVEL": "INFO" if verbose else "CRITICAL"}
    for name, value in {**_QUIET, **settings}.items():
        os.environ.setdefault(name, value)
    # Where there is a proxy to the world outside, it knows nothing of a server on this machine.
    for name in ("NO_PROXY", "no_proxy"):
        os.environ[name] = ",".join(filter(None, [os.environ.get(name, ""), "127.0.0.1", "localhost"]))


def start(home: Path) -> None:
    """Start the private server in the background, unless the user named a server in PREFECT_API_URL."""
    global _server, _url, _log
    if os.environ.get("PREFECT_API_URL"):
        return
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    _log = home / "logs" / "prefect_server.log"
    _log.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "uvicorn", "--factory", "prefect.server.api.server:create_app"]
    command += ["--host", "127.0.0.1", "--port", str(port), "--log-level", "error", "--timeout-keep-alive", "30"]
    with _log.open("wb") as file:
        _server = subprocess.Popen(
            command,
            env={**module_environment(os.environ), **_SERVER},
            stdout=file,
            stderr=file,
            stdin=subprocess.DEVNULL,
            preexec_fn=_detached,
        )
    atexit.register(stop)
    _url = f"http://127.0.0.1:{port}/api"


@contextlib.contextmanager
def connected() -> Iterator[None]:
    """Inside this block Prefect talks to the private server, where one was started; waits until it answers.

    Raises:
        RuntimeError: it ended or did not answer in time; the message names its log.
    """
    if _server is None:
        yield
        return
    _wait(_server)
    from prefect.settings import PREFECT_API_URL, PREFECT_FLOWS_HEARTBEAT_FREQUENCY, temporary_settings

    # Heartbeats tell a server that outlives its runs that they crashed; this one does not, and each costs 0.7 s.
    with temporary_settings({PREFECT_API_URL: _url, PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None}):
        yield


def _wait(server: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline:
        if server.poll() is not None:
            raise RuntimeError(f"the local Prefect server ended with code {server.returncode}; see {_log}")
        try:
            with urllib.request.urlopen(f"{_url}/health", timeout=5) as response:
                if response.status == 200:
                    return
        except (urllib.error.URLError, OSError):
            time.sleep(0.05)
    raise RuntimeError(f"the local Prefect server did not answer within {START_TIMEOUT_S:.0f} s; see {_log}")


def stop() -> None:
    """End the private server; called at exit."""
    global _server
    if _server is not None and _server.poll() is None:
        _server.terminate()
        try:
            _server.wait(timeout=5)
        except subprocess.TimeoutExpired:
            _server.kill()
    _server = None


def _detached() -> None:
    """In the server's process: it ends with us, but Ctrl-C in the terminal is for us to handle."""
    die_with_parent()
    os.setpgid(0, 0)
