"""The lock file has what the constraints have, with hashes of every package."""

import re
import tomllib
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
PINNED = re.compile(r"^([A-Za-z0-9._-]+)==(\S+)", re.MULTILINE)


OF_OLDER_PYTHON = {"async-timeout", "setuptools"}
"""What Python 3.11.0 to 3.11.2 and torch ask for besides, and the tested environment did not need."""


def normalised(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def pinned(name: str) -> dict[str, str]:
    found = PINNED.findall((REPOSITORY / name).read_text())
    return {normalised(package): version for package, version in found}


def test_versions_are_those_that_were_tested():
    locked, tested = pinned("requirements.lock"), pinned("constraints.txt")
    assert locked.keys() - tested.keys() <= OF_OLDER_PYTHON
    assert {name: tested.get(name, version) for name, version in locked.items()} == locked, "run .ci/lock"


def test_every_requirement_is_locked_but_torch():
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    asked = project["dependencies"] + project["optional-dependencies"]["test"]
    names = {normalised(re.match(r"[A-Za-z0-9._-]+", one)[0]) for one in asked}
    assert names - pinned("requirements.lock").keys() == {"torch"}, "run .ci/lock"


def test_every_package_has_hashes():
    text = (REPOSITORY / "requirements.lock").read_text()
    packages = re.split(r"^(?=[A-Za-z0-9])", text, flags=re.MULTILINE)[1:]
    assert len(packages) == len(pinned("requirements.lock")) > 100
    assert all(re.search(r"--hash=sha256:[0-9a-f]{64}", package) for package in packages)
    assert not re.search(r"https?:|file:", text.split("\n", 2)[2])
