"""Shared fixtures. Nothing here starts Prefect: only tests/flows does, and it runs the scripts as a user would."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from data_contracts.events import Events

# Sleeping OpenMP threads: spinning ones slow the tests several times on a busy machine.
_ENVIRONMENT = {
    "HF_HUB_OFFLINE": "1",
    "DO_NOT_TRACK": "1",
    "TRANSFORMERS_VERBOSITY": "error",
    "OMP_WAIT_POLICY": "PASSIVE",
    # A process of tests a core: more threads only wait for one another.
    "OMP_NUM_THREADS": "1",
}
for _name, _value in _ENVIRONMENT.items():
    os.environ.setdefault(_name, _value)

REPOSITORY = Path(__file__).resolve().parents[1]
REAL_DATA = REPOSITORY.parent / "shared" / "real"


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty home folder for the store."""
    monkeypatch.setenv("CTLEV_HOME", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.fixture
def at_once(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stages that run where they are called, without Prefect."""
    from tasks.stage import Stage
    from tasks.store import Store

    def call(stage, *inputs, label="", **settings):
        bound = stage.signature.bind(None, *inputs, **settings)
        bound.apply_defaults()
        arguments = dict(list(bound.arguments.items())[1:])
        return stage.run(stage.key(arguments, Store()), arguments)[0]

    monkeypatch.setattr(Stage, "__call__", call)


@pytest.fixture
def real_recordings() -> Path:
    """Three real recordings in class folders; they are not part of the repository."""
    folder = REAL_DATA / "events"
    if not folder.is_dir():
        pytest.skip("the real recordings are not beside this checkout")
    return folder


@pytest.fixture
def native_bfloat16(monkeypatch: pytest.MonkeyPatch) -> None:
    """bfloat16 as on processors that have instructions for it, whatever this one has."""
    monkeypatch.setattr("ctlev_core.cpu_precision.has_bfloat16", lambda: True)


@pytest.fixture
def one_thread() -> Iterator[None]:
    """One thread for torch, here and in processes started from here: where sums over threads are rounded otherwise."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", "1")
        yield
    torch.set_num_threads(before)


@pytest.fixture
def quick_two_sample_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """Networks of a quarter of their training: enough for what is plain, and for tests of what is compared."""
    monkeypatch.setattr("ctlev_core.realism.two_sample_network.NUM_STEPS", 30)


@pytest.fixture
def random_events() -> Events:
    """2,000 valid events on a 32 x 24 sensor."""
    random = np.random.default_rng(0)
    return Events(
        np.sort(random.integers(0, 100_000, 2000)).astype(np.int64),
        random.integers(0, 32, 2000).astype(np.uint16),
        random.integers(0, 24, 2000).astype(np.uint16),
        random.integers(0, 2, 2000).astype(np.uint8),
        (32, 24),
    )


@pytest.fixture(scope="session")
def s3_server() -> Iterator[str]:
    """The address of an S3 server on loopback, which the environment names with credentials for it."""
    pytest.importorskip("moto.server", reason="the extra `test` has moto, an S3 server on loopback")
    pytest.importorskip("s3fs", reason="the extra `bucket` has s3fs")
    import bucket_server

    with bucket_server.s3_server() as endpoint, pytest.MonkeyPatch.context() as patch:
        for name, value in {**bucket_server.CREDENTIALS, "AWS_ENDPOINT_URL": endpoint}.items():
            patch.setenv(name, value)
        yield endpoint


@pytest.fixture
def bucket_url(s3_server: str) -> str:
    """The home in a new bucket."""
    import bucket_server

    return bucket_server.new_bucket()
