"""Run the scripts the way a user does: as processes, with a home folder of their own."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import runpy
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from data_contracts.manifest import Manifest, ManifestRef, read_manifest
from tasks.stage import in_one_run

REPOSITORY = Path(__file__).resolve().parents[2]
REAL_RECORDINGS = REPOSITORY.parent / "shared" / "real" / "events"


@dataclass(frozen=True)
class Finished:
    """What a script printed and how it ended."""

    status: int
    output: str
    errors: str

    @property
    def plan(self) -> dict[str, tuple[str, str]]:
        """Label -> (`cached` or `to run`, key), of a dry run."""
        rows = re.findall(r"^(cached|to run) +(\S.*?) +([0-9a-f]{32})$", self.output, re.MULTILINE)
        return {label: (state, key) for state, label, key in rows}


def no_server() -> dict[str, str]:
    """The variables that lead to the Prefect server that tests share, and that conftest.py starts."""
    raise AssertionError("no server is shared")


shared_server = no_server


def script(name: str, *arguments: str, home: Path, own_server: bool = False, **popen) -> subprocess.Popen:
    """Start a flow script from an unrelated working directory.

    Left alone it starts a Prefect server for itself. That takes longer than a small flow, so that scripts are told of
    one that is there already, unless `own_server`.
    """
    home.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, str(REPOSITORY / "flows" / f"{name}.py"), "--home", str(home), *arguments]
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PREFECT_")}
    if not own_server:
        environment |= {**shared_server(), "CTLEV_SHOW_STAGES": "0"}
    return subprocess.Popen(
        command, cwd=home, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **popen
    )


def run_script(name: str, *arguments: str, home: Path, timeout: float = 500, own_server: bool = False) -> Finished:
    """Run a flow script to its end."""
    process = script(name, *arguments, home=home, own_server=own_server)
    output, errors = process.communicate(timeout=timeout)
    return Finished(process.returncode, output, errors)


def plan_script(name: str, *arguments: str, home: Path) -> Finished:
    """What a flow script does before it runs anything, in this process: its plan with `--dry-run`, or what it refuses.

    Scripts take seconds to start; a few tests start them for the same.
    """
    return _here(name, arguments, home)


def run_script_here(name: str, *arguments: str, home: Path) -> Finished:
    """Run a flow script to its end in this process, its stages one after the other and not as tasks of Prefect.

    For what is the same however a script is run: what its stages make of data and options.
    """
    with pytest.MonkeyPatch.context() as patch, in_one_run():
        patch.setattr("tasks.stage.run_as_task", lambda name, label, work: work()[0])
        patch.setattr("prefect.Task.__call__", lambda task, *arguments, **named: task.fn(*arguments, **named))
        return _here(name, arguments, home, connected=contextlib.nullcontext, with_plan=lambda flow, *_: flow.fn)


def _here(name: str, arguments: tuple[str, ...], home: Path, **patches: Any) -> Finished:
    home.mkdir(parents=True, exist_ok=True)
    output, errors = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CTLEV_HOME", str(home))
        patch.setattr(sys, "argv", [f"{name}.py", "--home", str(home), *arguments])
        from flows import command_line, local_server

        patch.setattr(local_server, "start", lambda home: None)
        patch.setattr(local_server, "connected", patches.get("connected", _not_reached))
        patch.setattr(command_line, "with_plan", patches.get("with_plan"))
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors), pytest.raises(SystemExit) as end:
            runpy.run_path(str(REPOSITORY / "flows" / f"{name}.py"), run_name="__main__")
    return Finished(int(end.value.code or 0), output.getvalue(), errors.getvalue())


@contextlib.contextmanager
def _not_reached(*_: str) -> Iterator[None]:
    raise AssertionError("the script begins to run")
    yield


def told_stages(errors: str) -> tuple[int, list[re.Match[str]]]:
    """How many stages a run said it has, and what it told of each: number, of how many, stage, rows."""
    first, *lines = [line for line in errors.splitlines() if line.strip()]
    total = re.match(r"(\d+) stages", first)
    told = [re.fullmatch(r"\[ *(\d+)/(\d+)\] (\w+).*  ([\d,]+) rows  [\d.]+ s(  about .* left)?", one) for one in lines]
    assert total and all(told), errors
    return int(total[1]), [one for one in told if one]


def artefacts(home: Path, stage: str, plugin: str = "") -> list[Manifest]:
    """Every artefact of a stage, its files checked; with `plugin` (kind/name) those that were made with it."""
    found = []
    for record in sorted((home / "artefacts" / stage).glob("*/run.json")):
        arguments = json.loads(record.read_text())["arguments"].values()
        used = [argument["plugin"] for argument in arguments if isinstance(argument, dict) and "plugin" in argument]
        if not plugin or plugin in used:
            found.append(read_manifest(ManifestRef(key=record.parent.name, path=record.parent), full=True))
    return found


def digests(home: Path, stages: tuple[str, ...] = ()) -> dict[str, str]:
    """Stage/key -> manifest digest of every finished artefact."""
    found = {}
    for record in sorted((home / "artefacts").glob("*/*/run.json")):
        stage = record.parent.parent.name
        if not stages or stage in stages:
            found[f"{stage}/{record.parent.name}"] = json.loads(record.read_text())["digest"]
    return found
