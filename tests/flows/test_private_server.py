"""The private Prefect server of a script: who may talk to it, and what happens when it ends."""

import base64
import contextlib
import http.client
import json
import os
import signal
import socket
import sqlite3
import subprocess
import sys
import textwrap
import time
import urllib.parse
from pathlib import Path

import deployment_service
import flow_scripts
import httpx
import pytest
from flow_scripts import digests, script

from tasks.store import Store


def ask(path, *, method="GET", body=None, **headers):
    """Status and headers of an answer of the server that tests share; only given headers are sent, beside the host."""
    place = urllib.parse.urlsplit(flow_scripts.shared_server()["PREFECT_API_URL"])
    connection = http.client.HTTPConnection(place.hostname or "", place.port, timeout=60)
    given = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.putrequest(method, f"/api{path}", skip_host="Host" in given)
    content = b"" if body is None else json.dumps(body).encode()
    for name, value in {**given, "Content-Length": str(len(content)), "Content-Type": "application/json"}.items():
        connection.putheader(name, value)
    connection.endheaders(content)
    answer = connection.getresponse()
    answer.read()
    return answer.status, {name.lower(): value for name, value in answer.getheaders()}


def authorization():
    return "Basic " + base64.b64encode(flow_scripts.shared_server()["PREFECT_API_AUTH_STRING"].encode()).decode()


def test_who_has_no_password_is_refused():
    for path, body in (("/flow_runs/filter", {}), ("/deployments/filter", {}), ("/work_pools/filter", {})):
        assert ask(path, method="POST", body=body)[0] == 401
        assert ask(path, method="POST", body=body, Authorization="Basic Y3RsZXY6")[0] == 401
        assert ask(path, method="POST", body=body, Authorization=authorization())[0] == 200


def test_web_pages_of_other_origins_are_refused():
    preflight = {"Access_Control_Request_Method": "POST", "Access_Control_Request_Headers": "authorization"}
    for origin in ("https://elsewhere.example", "null", "http://127.0.0.1:1"):
        for path, method in (("/flow_runs/filter", "OPTIONS"), ("/health", "GET")):
            _, headers = ask(path, method=method, Origin=origin, **(preflight if method == "OPTIONS" else {}))
            assert "access-control-allow-origin" not in headers, (origin, path)


def test_a_foreign_host_is_refused_for_its_owner_may_point_it_here():
    for host in ("elsewhere.example", "elsewhere.example:4200"):
        assert ask("/health", Host=host)[0] == 400
    assert ask("/health", Host="localhost")[0] == 200


def test_files_of_the_server_are_for_their_owner_alone(tmp_path_factory):
    flow_scripts.shared_server()
    (folder,) = {path.parent.resolve() for path in tmp_path_factory.getbasetemp().glob("server*/prefect")}
    found = [*(folder / "prefect").glob("prefect.db*"), *(folder / "logs").iterdir()]
    assert len(found) >= 2 and all(path.stat().st_mode & 0o077 == 0 for path in found)
    assert sqlite3.connect(folder / "prefect" / "prefect.db").execute("SELECT 1").fetchone() == (1,)


def test_a_database_that_others_could_read_is_closed_to_them(tmp_path, monkeypatch):
    from flows import local_server

    monkeypatch.setattr(os, "environ", dict(os.environ))
    (tmp_path / "prefect").mkdir()
    (tmp_path / "prefect" / "prefect.db").touch(0o644)
    local_server.configure(tmp_path, verbose=False)
    assert (tmp_path / "prefect" / "prefect.db").stat().st_mode & 0o777 == 0o600


def test_the_port_is_never_free_between_its_choice_and_its_use(tmp_path, monkeypatch):
    """The socket that is opened first is the one that is served on."""
    from flows import local_server

    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    started = []

    class Held(subprocess.Popen):
        def __init__(self, command, **options):
            self.port = socket.socket(fileno=os.dup(options["pass_fds"][0])).getsockname()[1]
            started.append(self)
            super().__init__([sys.executable, "-c", "import time; time.sleep(60)"], **options)

    with monkeypatch.context() as patch:
        patch.setattr(local_server.subprocess, "Popen", Held)
        for name in ("_server", "_url", "_password", "_log"):
            patch.setattr(local_server, name, getattr(local_server, name))
        local_server.start(tmp_path)
        assert local_server._url == f"http://127.0.0.1:{started[0].port}/api"
        with socket.socket() as other, pytest.raises(OSError, match="in use"):
            other.bind(("127.0.0.1", started[0].port))
        started[0].kill()
        started[0].wait()


@pytest.mark.slow
def test_a_server_started_as_the_docs_say_is_closed_to_others(tmp_path):
    with deployment_service.server(tmp_path) as service:
        place = {"PREFECT_API_URL": service.url, "PREFECT_API_AUTH_STRING": deployment_service.PASSWORD}
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(flow_scripts, "shared_server", lambda: place)
            test_who_has_no_password_is_refused()
            test_web_pages_of_other_origins_are_refused()
            own = service.url.removesuffix("/api")
            assert ask("/health", Origin=own)[1]["access-control-allow-origin"] == own
    text = (flow_scripts.REPOSITORY / "docs" / "operations.md").read_text()
    for name in ("PREFECT_API_AUTH_STRING", "PREFECT_SERVER_API_AUTH_STRING", "PREFECT_SERVER_CORS_ALLOWED_ORIGINS"):
        assert f"{name}=" in text


def children_of(pid):
    with contextlib.suppress(FileNotFoundError):
        return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return []


def server_of(pid):
    found = [child for child in children_of(pid) if b"private_server" in Path(f"/proc/{child}/cmdline").read_bytes()]
    return found[0] if found else None


def start_smoke(home):
    """A run of the smallest preset that has stored its first artefact."""
    process = script("full_experiment", "--preset", "smoke", home=home, own_server=True)
    deadline = time.monotonic() + 120
    while not digests(home) and time.monotonic() < deadline:
        assert process.poll() is None
        time.sleep(0.1)
    return process


@pytest.mark.slow
def test_a_run_whose_server_is_killed_ends_soon_and_keeps_its_stages(tmp_path):
    process = start_smoke(tmp_path)
    server = server_of(process.pid)
    assert server is not None
    os.kill(server, signal.SIGKILL)
    started = time.monotonic()
    _, errors = process.communicate(timeout=60)
    assert time.monotonic() - started < 15
    assert process.returncode == 2
    said = (
        "error: the local Prefect server ended with code -9 in the middle of the run; finished stages and checkpoints"
    )
    assert errors.count(said) == 1 and "Traceback" not in errors, errors
    for item in Store(tmp_path).artefacts():
        Store(tmp_path).check(item.folder)
    assert digests(tmp_path)


@pytest.mark.slow
def test_sigterm_ends_a_run_with_a_message(tmp_path):
    process = start_smoke(tmp_path)
    children = children_of(process.pid)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 143
    assert "ended by SIGTERM; finished stages and checkpoints are kept" in errors and "Traceback" not in errors, errors
    assert not any(os.path.exists(f"/proc/{child}") for child in children)


STUBBORN = """
    import signal, subprocess, sys, time
    from pathlib import Path
    from flows import local_server
    signal.signal(signal.SIGINT, signal.default_int_handler)  # what is started in the background ignores interrupts
    local_server._log = Path("LOG")
    local_server.END_TIMEOUT_S = 2.0
    import threading
    server = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(2)"])  # the run is in its loop by then
    threading.Thread(target=local_server._watch, args=(server, threading.Event()), daemon=True).start()
    while True:
        try:
            time.sleep(60)
        except KeyboardInterrupt:
            print("went on", flush=True)
"""


def test_a_run_that_does_not_mind_an_interrupt_is_ended():
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(STUBBORN)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and done.stdout == "went on\n"
    assert "error: the local Prefect server ended with code 0" in done.stderr and "LOG" in done.stderr


AT_ONCE = """
    import sys
    from pathlib import Path
    from flows import local_server
    local_server.configure(Path(sys.argv[1]), verbose=False)
    local_server.start(Path(sys.argv[1]))
    with local_server.connected():
        print("answers")
    sys.stdout.flush()
    local_server.stop()
"""


@pytest.mark.slow
def test_servers_that_start_at_once_in_a_new_home_all_answer(tmp_path):
    """Else both make the tables of the one database, and one ends with `duplicate column name`."""
    command = [sys.executable, "-c", textwrap.dedent(AT_ONCE), str(tmp_path)]
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PREFECT_")}
    started = [subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    assert [process.communicate(timeout=300)[0] for process in started] == ["answers\n"] * 2


UNREACHABLE = """
    import os
    from flows import local_server
    try:
        with local_server.connected():
            print("went on")
    except local_server.ServerLostError as error:
        print(error)
"""


def test_a_server_of_the_user_that_does_not_answer_is_told_of(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as closed:
        url = f"http://127.0.0.1:{closed.getsockname()[1]}/api"
    environment = {**os.environ, "PREFECT_API_URL": url, "PREFECT_HOME": str(tmp_path)}
    command = [sys.executable, "-c", textwrap.dedent(UNREACHABLE)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert done.stdout.startswith(f"PREFECT_API_URL: Failed to reach API at {url}/ (") and done.returncode == 0
    assert "start that server, or unset the variable" in done.stdout


@pytest.mark.parametrize("error", ["ConnectError", "ReadTimeout"])
def test_a_server_of_the_user_that_is_lost_in_the_middle_is_told_of(error, monkeypatch):
    from flows import local_server

    monkeypatch.setattr(local_server, "_server", None)
    monkeypatch.setattr(local_server, "_check_server_of_user", lambda: None)
    lost = pytest.raises(local_server.ServerLostError, match="the server was lost in the middle of the run: gone; fin")
    with lost, local_server.connected():
        raise getattr(httpx, error)("gone")
    with pytest.raises(KeyError), local_server.connected():
        raise KeyError("ours")


def test_a_private_server_that_cannot_start_is_told_of_with_its_log(tmp_path, monkeypatch):
    from flows import local_server

    ended = subprocess.Popen([sys.executable, "-c", "raise SystemExit(3)"])
    ended.wait()
    monkeypatch.setattr(local_server, "_server", ended)
    monkeypatch.setattr(local_server, "_log", tmp_path / "log")
    expected = pytest.raises(local_server.ServerLostError, match=f"ended with code 3; see {tmp_path}/log")
    with expected, local_server.connected():
        raise AssertionError


def test_what_is_to_come_is_said_before_the_server_answers(tmp_path, monkeypatch, capfd):
    from flows import local_server
    from flows.command_line import Asked, run_command
    from flows.full_experiment import COMMAND

    def lost(*modules):
        raise local_server.ServerLostError("none answers")

    monkeypatch.setenv("CTLEV_HOME", str(tmp_path))
    monkeypatch.setattr(local_server, "start", lambda home: None)
    monkeypatch.setattr(local_server, "connected", lost)
    assert run_command(COMMAND, Asked("smoke", [])) == 2
    told = capfd.readouterr().err.splitlines()
    assert told[0].startswith("59 stages; about ") and told[-1] == "error: none answers"
