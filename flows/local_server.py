"""Prefect without a server of the user's own: one private server for the life of one script.

Prefect would start such a server itself, but only when the first flow is called, with a 20 s limit that a busy
machine exceeds, and it outlives a killed script. Here it starts before anything heavy is imported, so that its start-up
overlaps ours, and it dies with the script, whatever ends the script. Where it ends before, the script ends too: Prefect
would ask it again and again.

It answers nobody but this script: other users of the machine and web pages in a browser on it lack the password, which
is made for each server, and pages of another origin or host are refused.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib
import os
import secrets
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from ctlev_core.processes import die_with_parent, module_environment

START_TIMEOUT_S = 300.0
LOOK_EVERY_S = 0.5
END_TIMEOUT_S = 8.0
"""After its server has ended, a script has so long to end by itself."""
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
    # Nobody reads events of a server that ends with its script, and SQLite has one writer at a time: each event stored
    # with its resources is a write that requests wait for. A study of 3,000 cached stages was given up so.
    "PREFECT_SERVER_SERVICES_EVENT_PERSISTER_ENABLED": "false",
    "PREFECT_SERVER_SERVICES_TRIGGERS_ENABLED": "false",
}
_server: subprocess.Popen[bytes] | None = None
_url = ""
_password = ""
_log = Path()


class ServerLostError(RuntimeError):
    """The server ended before the run did, or none answers."""


def environment() -> dict[str, str]:
    """Variables with which another process reaches the private server."""
    return {"PREFECT_API_URL": _url, "PREFECT_API_AUTH_STRING": _password}


def configure(home: Path, *, verbose: bool) -> None:
    """Point Prefect at `home` and keep it quiet. Must run before Prefect is imported; what the user set stays."""
    with contextlib.suppress(OSError):  # `main` says clearly that the home cannot be written
        (home / "prefect").mkdir(parents=True, exist_ok=True)
        for path in (home / "prefect").glob("prefect.db*"):  # made by earlier versions for all to read
            path.chmod(0o600)
    settings = {
        "PREFECT_HOME": str(home / "prefect"),
        "PREFECT_LOGGING_LEVEL": "INFO" if verbose else "CRITICAL",
        # A server on SQLite answers 503 after a minute of waiting for its turn to write. By default a question is asked
        # 5 times more, each pause twice as long: a minute of pauses. With 8 they are 9 minutes, with 20 days.
        "PREFECT_CLIENT_MAX_RETRIES": "8",
    }
    for name, value in {**_QUIET, **settings}.items():
        os.environ.setdefault(name, value)
    # Where there is a proxy to the world outside, it knows nothing of a server on this machine.
    for name in ("NO_PROXY", "no_proxy"):
        os.environ[name] = ",".join(filter(None, [os.environ.get(name, ""), "127.0.0.1", "localhost"]))


def start(home: Path) -> None:
    """Start the private server in the background, unless the user named a server in PREFECT_API_URL."""
    global _server, _url, _password, _log
    if os.environ.get("PREFECT_API_URL"):
        return
    _log = home / "logs" / "prefect_server.log"
    _log.parent.mkdir(parents=True, exist_ok=True)
    _password = f"ctlev:{secrets.token_urlsafe(32)}"
    with _private(_log) as file, socket.create_server(("127.0.0.1", 0)) as listening:
        origin = f"http://127.0.0.1:{listening.getsockname()[1]}"
        access = {"PREFECT_SERVER_API_AUTH_STRING": _password, "PREFECT_SERVER_CORS_ALLOWED_ORIGINS": origin}
        _server = subprocess.Popen(
            [sys.executable, "-P", str(Path(__file__).with_name("private_server.py")), str(listening.fileno())],
            env={**module_environment(os.environ), **_SERVER, **access},
            stdout=file,
            stderr=file,
            stdin=subprocess.DEVNULL,
            pass_fds=[listening.fileno()],
            preexec_fn=_detached,
        )
    atexit.register(stop)
    _url = f"{origin}/api"


@contextlib.contextmanager
def connected(*modules: str) -> Iterator[None]:
    """Inside this block Prefect talks to the private server, where one was started; waits until it answers.

    Args:
        modules: what will be imported anyway, and is while the server starts.
    Raises:
        ServerLostError: it ended, or did not answer in time; the message names its log. Or nobody answers at the
            address that the user named, or nobody does any more.
    """
    if _server is None:
        with _server_of_user():
            yield
        return
    # Before we wait: the server needs seconds to start, and so do these.
    for name in ("prefect.flow_engine", "prefect.task_engine", *modules):
        importlib.import_module(name)
    from prefect.settings import (
        PREFECT_API_AUTH_STRING,
        PREFECT_API_URL,
        PREFECT_FLOWS_HEARTBEAT_FREQUENCY,
        temporary_settings,
    )

    _wait(_server)
    # Heartbeats tell a server that outlives its runs that they crashed; this one does not, and each costs 0.7 s.
    ended = threading.Event()
    threading.Thread(target=_watch, args=(_server, ended), daemon=True).start()
    try:
        with temporary_settings(
            {PREFECT_API_URL: _url, PREFECT_API_AUTH_STRING: _password, PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None}
        ):
            yield
    except BaseException as error:
        # What Prefect raises where nobody answers says less, and may come before the server is known to have ended.
        with contextlib.suppress(subprocess.TimeoutExpired):
            _server.wait(2 * LOOK_EVERY_S if isinstance(error, Exception) else 0)
        if _server.poll() is None:
            raise
        raise ServerLostError(_lost(_server)) from error
    finally:
        ended.set()


@contextlib.contextmanager
def _server_of_user() -> Iterator[None]:
    """As `connected`, with the server in PREFECT_API_URL."""
    import httpx

    _check_server_of_user()
    try:
        yield
    except httpx.HTTPError as error:  # Prefect asked it again and again; nothing else here asks a server
        told = (str(error) or type(error).__name__).splitlines()[0]
        raise ServerLostError(
            f"PREFECT_API_URL: the server was lost in the middle of the run: {told}; finished stages and checkpoints "
            "are kept, so start that server and run it again"
        ) from error


def _check_server_of_user() -> None:
    """Raise `ServerLostError` unless the server in PREFECT_API_URL answers us, and speaks our version."""
    from prefect.client.orchestration import get_client

    try:
        with get_client(sync_client=True) as client:
            client.raise_for_api_version_mismatch()
    except Exception as error:  # of httpx, of Prefect, of what answers in the place of a server
        told = (str(error) or type(error).__name__).splitlines()[0]
        cause = f" ({error.__cause__})" if error.__cause__ else ""
        raise ServerLostError(
            f"PREFECT_API_URL: {told}{cause}; start that server, or unset the variable: then a "
            "run has a server of its own"
        ) from error


def _lost(server: subprocess.Popen[bytes]) -> str:
    return (
        f"the local Prefect server ended with code {server.returncode} in the middle of the run; finished stages and "
        f"checkpoints are kept, so run it again; its log is {_log}"
    )


def _watch(server: subprocess.Popen[bytes], ended: threading.Event) -> None:
    """Interrupt the run where the server ends before it does, and end it where it does not mind."""
    while not ended.wait(LOOK_EVERY_S):
        if server.poll() is None:
            continue
        # To the main thread by name: one sent to the process may go to a thread that leaves the main one asleep.
        with contextlib.suppress(OSError):
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
        told = ended.wait(END_TIMEOUT_S / 2)
        # Also where the run has ended: threads of Prefect's that a script waits for go on asking.
        time.sleep(END_TIMEOUT_S / 2)
        if not told:
            print(f"error: {_lost(server)}", file=sys.stderr, flush=True)
        os._exit(2)


def _wait(server: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline:
        if server.poll() is not None:
            raise ServerLostError(f"the local Prefect server ended with code {server.returncode}; see {_log}")
        try:
            with urllib.request.urlopen(f"{_url}/health", timeout=5) as response:
                if response.status == 200:
                    return
        except (urllib.error.URLError, OSError):
            time.sleep(0.05)
    raise ServerLostError(f"the local Prefect server did not answer within {START_TIMEOUT_S:.0f} s; see {_log}")


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


def _private(path: Path) -> IO[bytes]:
    """A new file that only its owner may read."""
    # Of two processes that start at once, the file of the later one gets the name.
    new = path.with_name(f".{path.name}.{os.getpid()}")
    new.unlink(missing_ok=True)
    file = os.fdopen(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb")
    new.replace(path)
    return file


def _detached() -> None:
    """In the server's process: it ends with us, but Ctrl-C in the terminal is for us to handle."""
    die_with_parent()
    os.setpgid(0, 0)
