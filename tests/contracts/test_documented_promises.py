"""Every test that the docs name as the proof of a promise is there."""

import re
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
TESTS = {path.name: path for path in (REPOSITORY / "tests").rglob("test_*.py")}


@pytest.mark.parametrize("page", ["docs/operations.md", "README.md", "SECURITY.md"])
def test_named_tests_are_there(page):
    text = (REPOSITORY / page).read_text()
    named = re.findall(r"`[./a-z0-9_]*?(test_[a-z0-9_]+\.py)(?:::(test_[a-z0-9_]+))?`", text)
    for file, test in named:
        assert file in TESTS, f"{page}: {file}"
        assert not test or re.search(rf"^def {test}\b", TESTS[file].read_text(), re.M), f"{page}: {file}::{test}"
    assert len(named) >= {"docs/operations.md": 30}.get(page, 0)


def test_every_promise_of_the_threat_model_has_a_test():
    text = (REPOSITORY / "docs" / "operations.md").read_text()
    part = text.split("## What is trusted, and what is not")[1].split("\n## ")[0]
    rows = [line for line in part.splitlines() if line.startswith("| ") and "from elsewhere" not in line]
    assert len(rows) >= 10 and all("test_" in row for row in rows)
