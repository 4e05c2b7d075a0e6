"""Run the scripts the way a user does: as processes, with a home folder of their own."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from data_contracts.manifest import Manifest, ManifestRef, read_manifest

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


def script(name: str, *arguments: str, home: Path, **popen) -> subprocess.Popen:
    """Start a flow script from an unrelated working directory."""
    home.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, str(REPOSITORY / "flows" / f"{name}.py"), "--home", str(home), *arguments]
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PREFECT_")}
    return subprocess.Popen(
        command, cwd=home, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **popen
    )


def run_script(name: str, *arguments: str, home: Path, timeout: float = 500) -> Finished:
    """Run a flow script to its end."""
    process = script(name, *arguments, home=home)
    output, errors = process.communicate(timeout=timeout)
    return Finished(process.returncode, output, errors)


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
