"""Runs that are killed with everything they started, at random moments, and run again until one ends by itself.

CTLEV_KILLS sets how many are killed, 10 unless given.
"""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from deployment_service import server
from flow_scripts import REPOSITORY, digests

from ctlev_core.processes import die_with_parent
from tasks.store import Store

KILLS = int(os.environ.get("CTLEV_KILLS", "10"))
MAX_NEW, LONGEST_S = 4, 1.0
"""A run is killed when it has stored fewer new artefacts than this, drawn at random, and as long after as is drawn too:
`smoke` has some forty, so that the kills are spread over all of it, however busy the machine is."""
TIMED = {"report"}
"""Its digest covers the time that each stage took."""


@pytest.mark.release
@pytest.mark.timeout(3600 + 60 * KILLS)
def test_killed_runs_end_in_the_digests_of_an_undisturbed_one(smoke_home, tmp_path):
    with server(tmp_path) as service:  # to start one for each run would take longer than all the rest
        kill_and_run_again(service.environment, tmp_path, deterministic(smoke_home))


def kill_and_run_again(environment, folder, expected):
    random = np.random.default_rng(20261122)
    homes, kills, ended, at_work, halted = 0, 0, False, 0, set()
    while kills < KILLS or not ended:
        home = folder / str(homes)
        home.mkdir(exist_ok=True)
        before = unfinished(home)
        process = subprocess.Popen(
            [sys.executable, REPOSITORY / "flows" / "full_experiment.py", "--preset", "smoke", "--home", home],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            preexec_fn=die_with_parent,
        )
        waiting = kills < KILLS
        if waiting and waits_for_work(process, home, int(random.integers(MAX_NEW))):
            time.sleep(random.uniform(0, LONGEST_S))
        if waiting and process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            kills, ended = kills + 1, False
            at_work += bool(unfinished(home) - before)
            halted |= unfinished(home)
            check_all(home)
            continue
        _, errors = process.communicate()
        assert process.returncode == 0, errors
        check_all(home)
        assert deterministic(home) == expected
        assert not list((home / "tmp").iterdir())
        homes, ended = homes + 1, True  # where kills are left they go on with another
    print(f"{kills} kills in {homes} homes, {at_work} of them with stages at work, {len(halted)} different ones")
    assert at_work >= KILLS // 4, "most kills hit a stage at its work"


def waits_for_work(process, home, count):
    """Wait until a run is past the start of Prefect and has stored `count` artefacts; False where it ends before."""
    began, stored = time.time(), num_stored(home)
    while process.poll() is None:
        locks = (path.stat().st_mtime for path in (home / "locks").glob("*") if path.name != "store")
        if any(time_s > began for time_s in locks) and num_stored(home) >= stored + count:
            return True
        time.sleep(0.02)
    return False


def unfinished(home):
    return {path.name for path in (home / "tmp").glob("*")}


def num_stored(home):
    return sum(1 for _ in home.glob("artefacts/*/*/run.json"))


def check_all(home):
    """Whatever bears the name of an artefact is whole."""
    for folder in (home / "artefacts").glob("*/*"):
        Store(home).check(folder)


def deterministic(home):
    return {name: digest for name, digest in digests(home).items() if name.partition("/")[0] not in TIMED}
