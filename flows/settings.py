"""Environment of every flow, set before Prefect is imported: `from flows.settings import flow`.

All state lies under one folder: `--home`, else the variable CTLEV_HOME, else `.ctlev` in the working directory.
Nothing here reaches out: telemetry and update checks are off, and model hubs are never asked.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from flows import local_server

_ENVIRONMENT = {
    # Idle OpenMP threads that spin cost a busy machine most of its speed: 30 training steps of the pose network with
    # two threads took 44 s spinning and 11 s sleeping while another process had one of the two cores.
    "OMP_WAIT_POLICY": "PASSIVE",
    "HF_HUB_OFFLINE": "1",
    "HF_HUB_DISABLE_TELEMETRY": "1",
    "HF_HUB_DISABLE_PROGRESS_BARS": "1",
    "TRANSFORMERS_VERBOSITY": "error",
    "DIFFUSERS_VERBOSITY": "error",
    "TOKENIZERS_PARALLELISM": "false",
}


def _configure() -> Path:
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--home", type=Path)
    parser.add_argument("--verbose", action="store_true")
    known, _ = parser.parse_known_args(sys.argv[1:])
    home = (known.home or Path(os.environ.get("CTLEV_HOME", ".ctlev"))).absolute()
    os.environ["CTLEV_HOME"] = str(home)
    for name, value in _ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    local_server.configure(home, verbose=known.verbose)
    # `python flows/full_experiment.py` puts this folder on the path, where evaluate.py would hide a package.
    folder = str(Path(__file__).resolve().parent)
    sys.path[:] = [entry for entry in sys.path if not entry or str(Path(entry).resolve()) != folder]
    return home


HOME = _configure()

from prefect import flow  # noqa: E402  (Prefect reads its settings when it is imported)

__all__ = ["HOME", "flow"]
