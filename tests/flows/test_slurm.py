"""Shards and stages in jobs of a real SLURM cluster, of this machine alone: the same results, whatever ends a job."""

import importlib.util
import shutil
import subprocess
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import job_calls
import pytest
import slurm_cluster
from flow_scripts import digests, run_script, script
from job_calls import hold_memory, note_and_wait, number_and_job, page_faults, variable
from slurm_cluster import ACCOUNT, PARTITION, cancel, queued

from data_contracts.errors import DataError
from tasks import runners
from tasks.runners import WorkerError
from tasks.workers import map_shards

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(slurm_cluster.MISSING), reason=f"not installed: {', '.join(slurm_cluster.MISSING)}"),
    pytest.mark.skipif(importlib.util.find_spec("dask_jobqueue") is None, reason="dask_jobqueue is not installed"),
    pytest.mark.filterwarnings("default"),  # theirs
]
TIMED = {"report"}
"""Its digest covers the time that each stage took."""
JOBS = {
    "CORES": "2",
    "MEMORY": "3GB",
    "QUEUE": PARTITION,
    "ACCOUNT": ACCOUNT,
    "WALLTIME": "00:20:00",
    "JOB_EXTRA_DIRECTIVES": "['--comment=of-a-test']",
    "INTERFACE": "lo",
}


def own_mounts_are_allowed():
    """A process with file systems of its own: another machine, as far as disks go."""
    command = ["unshare", "--mount", "mount", "-t", "tmpfs", "none", "/mnt"]
    return shutil.which("unshare") is not None and subprocess.run(command, check=False).returncode == 0


@pytest.fixture(scope="module")
def cluster():
    """The variables that lead to it. Sockets have short paths, so that its files are not where those of tests are."""
    with tempfile.TemporaryDirectory() as folder, slurm_cluster.slurm_cluster(Path(folder)) as environment:
        yield environment


@pytest.fixture
def jobs(cluster, tmp_path, monkeypatch):
    """Jobs of two workers each, for what this process computes."""
    use(cluster, tmp_path, monkeypatch)
    yield cluster
    end_jobs(cluster)


def use(cluster, home, patch):
    for name, value in {**cluster, **{f"DASK_JOBQUEUE__SLURM__{name}": value for name, value in JOBS.items()}}.items():
        patch.setenv(name, value)
    patch.setenv("CTLEV_HOME", str(home))
    patch.setenv("PYTHONPATH", str(Path(job_calls.__file__).parent))
    import dask

    dask.config.refresh()
    patch.setattr("tasks.slurm.LOOK_EVERY_S", 1.0)


def end_jobs(cluster):
    for runner in list(runners._running.values()):
        runner.close()
    wait_until(lambda: not queued(cluster))


def wait_until(condition):
    until = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.1)


def configured(patch, name, value):
    import dask

    patch.setenv(f"DASK_JOBQUEUE__SLURM__{name}", value)
    dask.config.refresh()


def test_a_job_is_what_the_configuration_says(jobs, monkeypatch):
    monkeypatch.setenv("CTLEV_RUNNER", "slurm")
    names = ["SLURM_JOB_PARTITION", "SLURM_JOB_ACCOUNT", "SLURM_CPUS_ON_NODE", "CTLEV_CORES", "CTLEV_RUNNER"]
    assert list(map_shards(variable, names)) == [PARTITION, ACCOUNT, "2", "1", "threads"]
    (job,) = queued(jobs)
    shown = subprocess.run(["scontrol", "show", "job", job], capture_output=True, text=True, check=True).stdout
    for said in ("TimeLimit=00:20:00", "mem=3G", "Comment=of-a-test"):
        assert said in shown
    # Two workers with the cores of both: for networks that use several threads.
    end_jobs(jobs)
    configured(monkeypatch, "CORES", "4")
    configured(monkeypatch, "PROCESSES", "2")
    assert list(map_shards(variable, ["SLURM_CPUS_ON_NODE", "CTLEV_CORES"])) == ["4", "2"]
    assert runners.asked_cluster(1).count == 2


def test_workers_with_little_free_memory_take_further_calls(jobs, monkeypatch):
    monkeypatch.setenv("CTLEV_RUNNER", "slurm")
    runner = runners.asked_cluster(1)
    with ThreadPoolExecutor(2) as threads:
        first = list(threads.map(lambda _: runner.call(hold_memory, 0.88), range(2)))
    assert {runner.call(hold_memory, 0.88) for _ in range(4)} <= set(first), "the same processes"


def test_freed_memory_is_kept_for_what_comes_next(jobs, monkeypatch):
    """Given back, as Dask has it, each array of a network would be new pages to the kernel: as slow again."""
    monkeypatch.setenv("CTLEV_RUNNER", "slurm")
    assert runners.asked_cluster(1).call(page_faults, 20) < 20_000 / 4


def test_shards_of_a_cancelled_job_are_computed_again(jobs, monkeypatch):
    monkeypatch.setenv("CTLEV_RUNNER", "slurm:2")
    found = map_shards(number_and_job, range(40), max_group=1)
    first = next(found)
    wait_until(lambda: len(runners.asked_cluster(1)._own.observed) == 4)
    before = queued(jobs, "RUNNING")
    assert len(before) == 2 and first[1] in before
    cancel(first[1], jobs)
    rows = [first, *found]
    assert [shard for shard, _ in rows] == list(range(40))
    wait_until(lambda: len(queued(jobs, "RUNNING")) == 2)
    assert set(queued(jobs, "RUNNING")) - set(before), "another was submitted"


@pytest.mark.release
def test_a_run_whose_job_is_cancelled_has_the_digests_of_threads(smoke_home, cluster, tmp_path, monkeypatch):
    monkeypatch.setenv("CTLEV_RUNNER", "slurm:2")
    home = tmp_path / "home"
    use(cluster, home, monkeypatch)
    process = script("full_experiment", "--preset", "smoke", home=home)
    cancelled = []

    def cancel_one():
        while process.poll() is None and not cancelled:
            if len(digests(home)) >= 8 and (running := queued(cluster, "RUNNING")):
                cancel(running[0], cluster)
                cancelled.append(running[0])
            time.sleep(0.1)

    watcher = threading.Thread(target=cancel_one)
    watcher.start()
    try:
        _, errors = process.communicate(timeout=900)
    finally:
        process.kill()
        watcher.join()
    assert process.returncode == 0, errors
    assert cancelled
    expected = digests(smoke_home)
    assert {name: digest for name, digest in digests(home).items() if name.partition("/")[0] not in TIMED} == {
        name: digest for name, digest in expected.items() if name.partition("/")[0] not in TIMED
    }
    wait_until(lambda: not queued(cluster))
    assert not [path.name for path in (home / "slurm").iterdir() if path.suffix not in (".err", ".out")]


def test_a_sweep_in_jobs_ends_on_one_page_and_its_runs_are_compared(smoke_home, cluster, tmp_path, monkeypatch):
    monkeypatch.setenv("CTLEV_RUNNER", "slurm")
    home = Path(shutil.copytree(smoke_home, tmp_path / "home", symlinks=True))
    before = digests(home)
    use(cluster, home, monkeypatch)
    finished = run_script("full_experiment", "--preset", "smoke", "--set", "num_synthetic=8,6", home=home)
    assert finished.status == 0, finished.errors
    wait_until(lambda: not queued(cluster))
    assert list((home / "slurm").glob("*.out")), "it ran in jobs"
    made = digests(home).keys() - before.keys()
    assert {name.partition("/")[0] for name in made} >= {"sample", "train_downstream", "score_model", "study_report"}
    page = (home / "reports" / "smoke_num_synthetic_8_6.html").read_text()
    assert "num synthetic 8" in page and "num synthetic 6" in page
    names = [f"smoke_num_synthetic_8_6/num_synthetic_{count}" for count in (8, 6)]
    compared = run_script("compare", *names, home=home)
    assert compared.status == 0, compared.errors
    assert "Differences: 1 in options" in compared.output and "0 in code" in compared.output
    assert (home / "reports" / "compare_num_synthetic_8_num_synthetic_6.html").is_file()


def test_jobs_are_as_many_as_there_is_work_for(jobs, tmp_path, monkeypatch):
    monkeypatch.setattr("tasks.slurm.IDLE_S", 2)
    monkeypatch.setenv("CTLEV_RUNNER", "slurm:0-2")
    before = set(queued(jobs, "all"))  # SLURM remembers those that ended, for a while
    runner = runners.asked_cluster(1)
    assert runner.count == 4
    time.sleep(3)
    assert set(queued(jobs, "all")) <= before
    with ThreadPoolExecutor(4) as threads:
        calls = [tmp_path / str(number) for number in range(4)]
        waiting = [threads.submit(runner.call, note_and_wait, call) for call in calls]
        wait_until(lambda: all((call / "jobs").exists() for call in calls))
        ran_in = [(call / "jobs").read_text().split() for call in calls]
        assert sorted(queued(jobs)) == sorted({job for jobs_of_one in ran_in for job in jobs_of_one})
        # A call of each job ends: two workers would do, but each job has another call that would begin anew.
        for job in queued(jobs):
            (calls[ran_in.index([job])] / "go_on").touch()
        time.sleep(8)
        assert len(queued(jobs, "RUNNING")) == 2
        for call in calls:
            (call / "go_on").touch()
        assert [call.result(60) for call in waiting] == [1] * 4
    wait_until(lambda: not queued(jobs))


def test_a_job_that_sbatch_refuses_is_an_error_with_its_message(jobs, monkeypatch):
    configured(monkeypatch, "QUEUE", "nowhere")
    monkeypatch.setenv("CTLEV_RUNNER", "slurm")
    with pytest.raises(WorkerError, match=r"3 times jobs ended, or were refused.*[Ii]nvalid partition specified"):
        list(map_shards(number_and_job, range(2)))


def test_jobs_that_fail_are_an_error_with_the_last_line_of_their_log(jobs, monkeypatch):
    configured(monkeypatch, "JOB_SCRIPT_PROLOGUE", "['echo no such module >&2; exit 1']")
    monkeypatch.setenv("CTLEV_RUNNER", "slurm")
    with pytest.raises(
        WorkerError, match=r"job \d+, FAILED \(NonZeroExitCode\); .*dask-worker-\d+.err: no such module"
    ):
        list(map_shards(number_and_job, range(2)))


@pytest.mark.skipif(not own_mounts_are_allowed(), reason="no file systems of one's own are allowed here")
def test_a_node_without_the_home_is_an_error_that_names_it(tmp_path, monkeypatch):
    home, shared = tmp_path / "home", tmp_path / "shared"
    home.mkdir()
    shared.mkdir()
    with tempfile.TemporaryDirectory() as folder, slurm_cluster.slurm_cluster(Path(folder), hidden=home) as cluster:
        use(cluster, home, monkeypatch)
        monkeypatch.setenv("CTLEV_RUNNER", "slurm")
        with pytest.raises(WorkerError, match=f"do all nodes see {home}/slurm, under the same path?"):
            list(map_shards(number_and_job, range(2)))
        # Jobs that can connect, for their logs and keys are elsewhere.
        configured(monkeypatch, "LOG_DIRECTORY", str(shared))
        configured(monkeypatch, "SHARED_TEMP_DIRECTORY", str(shared))
        with pytest.raises(DataError, match=rf"job \d+ on .* does not see the home {home};"):
            list(map_shards(number_and_job, range(2)))
        end_jobs(cluster)
