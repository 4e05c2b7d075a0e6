"""Fuzzing takes minutes: it runs only where the slow mark is asked for, `pytest -m slow tests/fuzz`."""

from __future__ import annotations

import pytest


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if "slow" in (config.getoption("markexpr") or ""):
        return
    for item in items:
        if "tests/fuzz/" in item.path.as_posix():
            item.add_marker(pytest.mark.skip(reason="fuzzing runs with -m slow"))
