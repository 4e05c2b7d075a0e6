"""A SLURM cluster of this machine alone: munged, slurmctld and slurmd on loopback, with all files in one folder."""

from __future__ import annotations

import contextlib
import getpass
import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

from ctlev_core.processes import die_with_parent

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "scancel", "sinfo")
_SEARCHED = os.pathsep.join([os.environ.get("PATH", os.defpath), "/usr/sbin", "/sbin"])
MISSING = [program for program in PROGRAMS if shutil.which(program, path=_SEARCHED) is None]
CORES = 4
"""That SLURM deals out, whatever the machine has."""
PARTITION, ACCOUNT = "short", "events"
START_TIMEOUT_S = 60.0

_CONFIGURATION = """\
ClusterName=ctlev
SlurmctldHost={host}(127.0.0.1)
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
SlurmctldPort={controller_port}
SlurmdPort={node_port}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
# Without control groups, which a container may not have.
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
MpiDefault=none
SlurmdParameters=config_overrides
CommunicationParameters=NoInAddrAny,NoCtldInAddrAny
ReturnToService=2
KillWait=5
SchedulerParameters=batch_sched_delay=0,sched_min_interval=100000
NodeName=node NodeHostname={host} NodeAddr=127.0.0.1 CPUs={cores} RealMemory=8000 State=UNKNOWN
PartitionName={partition} Nodes=node Default=YES MaxTime=INFINITE State=UP
"""


@contextlib.contextmanager
def slurm_cluster(folder: Path, hidden: Path | None = None) -> Iterator[dict[str, str]]:
    """Run the three daemons within this block.

    Args:
        folder: of their files; with a short path, for one is a socket.
        hidden: a folder that is empty on the node, as where a disk is not shared.
    Yields:
        The variables that lead SLURM's programs to them.
    Raises:
        RuntimeError: the node is not idle within `START_TIMEOUT_S`, with the ends of the logs.
    """
    for name in ("state", "spool"):
        (folder / name).mkdir()
    key = folder / "munge.key"
    key.write_bytes(os.urandom(1024))
    key.chmod(0o400)
    ports = _free_ports(2)
    text = _CONFIGURATION.format(
        host=socket.gethostname(),
        user=getpass.getuser(),
        folder=folder,
        controller_port=ports[0],
        node_port=ports[1],
        cores=CORES,
        partition=PARTITION,
    )
    configuration = folder / "slurm.conf"
    configuration.write_text(text)
    environment = {"SLURM_CONF": str(configuration), "PATH": _SEARCHED}
    files = {"socket": "socket", "key-file": "key", "pid-file": "pid", "log-file": "log", "seed-file": "seed"}
    munge = [f"--{option}={folder}/munge.{name}" for option, name in files.items()]
    node = ["slurmd", "-D", "-N", "node"]
    if hidden is not None:
        node = ["unshare", "--mount", "sh", "-c", 'mount -t tmpfs none "$0" && exec "$@"', str(hidden), *node]
    commands = (["munged", "--foreground", "--force", *munge], ["slurmctld", "-D"], node)
    with contextlib.ExitStack() as stack:
        for command in commands:
            stack.enter_context(_running(command, environment, folder))
        stack.callback(_cancel_all, environment)
        _wait_until_idle(environment, folder)
        yield environment


def queued(environment: Mapping[str, str], states: str = "PENDING,RUNNING,COMPLETING") -> list[str]:
    """Numbers of the jobs in these states."""
    command = ["squeue", "--noheader", f"--states={states}", "--format=%A"]
    return _output(command, environment).split()


def cancel(job: str, environment: Mapping[str, str]) -> None:
    """End a job, as its user would."""
    _output(["scancel", job], environment)


def _output(command: list[str], environment: Mapping[str, str]) -> str:
    return subprocess.run(
        command, env=os.environ | dict(environment), check=True, capture_output=True, text=True, timeout=60
    ).stdout


@contextlib.contextmanager
def _running(command: list[str], environment: Mapping[str, str], folder: Path) -> Iterator[None]:
    with (folder / f"{command[0]}.out").open("w") as output:
        process = subprocess.Popen(
            command,
            env=os.environ | dict(environment),
            stdout=output,
            stderr=subprocess.STDOUT,
            preexec_fn=die_with_parent,
        )
    try:
        yield
    finally:
        process.terminate()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _wait_until_idle(environment: Mapping[str, str], folder: Path) -> None:
    until = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < until:
        with contextlib.suppress(subprocess.CalledProcessError):
            if _output(["sinfo", "--noheader", "--format=%T"], environment).strip() == "idle":
                return
        time.sleep(0.2)
    ends = [
        f"{path.name}: {path.read_text()[-1000:]}"
        for path in sorted(folder.glob("*.*"))
        if path.suffix in (".log", ".out")
    ]
    raise RuntimeError("SLURM's node is not idle\n" + "\n".join(ends))


def _cancel_all(environment: Mapping[str, str]) -> None:
    """What runs in jobs outlives slurmd."""
    with contextlib.suppress(subprocess.SubprocessError):
        _output(["scancel", f"--user={getpass.getuser()}"], environment)
        until = time.monotonic() + 30
        while queued(environment) and time.monotonic() < until:
            time.sleep(0.2)


def _free_ports(count: int) -> list[int]:
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]
        return [one.getsockname()[1] for one in sockets]
