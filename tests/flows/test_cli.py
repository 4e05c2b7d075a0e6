"""The command `ctlev`, in this process and as one of its own."""

from __future__ import annotations

import importlib
import importlib.util
import os
import pkgutil
import re
import shutil
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest
from flow_scripts import REPOSITORY, run_script, run_script_here, told_stages
from typer.testing import CliRunner

from ctlev_core import __version__
from flows import cli
from flows.preset_list import PRESETS, preset_names, read_head

COMMANDS = (
    "run", "plan", "prepare", "train", "synthesize", "evaluate", "baselines", "export-events", "speed-vs-error",
    "realism-chain", "pretrain", "simulate", "record", "regenerate", "compare", "verify", "prune", "show",
    "presets", "options",
)  # fmt: skip


def ctlev(*arguments: str, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """The console script as a process: its own folder is first on the path, and the working directory is not."""
    code = "import sys; from flows.cli import main; sys.argv[0] = 'ctlev'; main()"
    own = {name: value for name, value in os.environ.items() if not name.startswith(("PREFECT_", "CTLEV_"))}
    command = [sys.executable, "-P", "-c", code, *arguments]
    return subprocess.run(
        command, cwd=cwd, env=own | {"PYTHONPATH": str(REPOSITORY)} | environment, capture_output=True, text=True
    )


def invoke(*arguments: str) -> tuple[int, str, str]:
    result = CliRunner().invoke(cli.app, list(arguments))
    return result.exit_code, result.stdout, result.stderr


def test_help_names_every_command():
    status, output, _ = invoke("--help")
    assert status == 0
    assert all(re.search(rf"\b{command}\b", output) for command in COMMANDS)
    for command in COMMANDS:
        assert invoke(command, "--help")[0] == 0


def test_version_is_that_of_the_package():
    assert invoke("--version")[:2] == (0, f"ctlev {__version__}\n")


def test_presets_are_told_a_line_each():
    status, output, _ = invoke("presets")
    assert status == 0
    lines = output.splitlines()
    for name in preset_names():
        (line,) = [line for line in lines[: lines.index("")] if line.split()[0] == name]
        assert line.endswith(")")


@pytest.mark.parametrize("arguments", [["presets"], ["--version"]])
def test_output_that_cannot_be_written_is_an_error(arguments):
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "flows.cli", *arguments]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=120, cwd=REPOSITORY)
    assert (done.returncode, done.stderr) == (2, "error: [Errno 28] No space left on device\n")


def test_plan_is_the_dry_run_of_the_script(tmp_path):
    plan = invoke("run", "smoke", "--dry-run", "--home", str(tmp_path))
    assert plan[0] == 0
    from flow_scripts import plan_script

    keys = re.findall(r"[0-9a-f]{32}", plan[1])
    assert keys == re.findall(
        r"[0-9a-f]{32}", plan_script("full_experiment", "--preset", "smoke", "--dry-run", home=tmp_path).output
    )
    swept = invoke("plan", "smoke", "--set", "num_synthetic=9,12", "--home", str(tmp_path))
    assert swept[0] == 0 and "smoke_num_synthetic_9" in swept[1] and "study_report" in swept[1]


@pytest.mark.parametrize("preset", ["smoke", "pose", "demo"])
def test_a_plan_in_an_empty_home_takes_about_as_long_as_its_preset_says(tmp_path, preset):
    """The costs that come with the project are of the amounts of work that a plan counts: half to twice the time."""
    status, output, _ = invoke("plan", preset, "--home", str(tmp_path))
    assert status == 0
    (told,) = re.findall(r"the rest: about (.*?) with", output)
    assert 0.5 < _seconds(told) / _seconds(read_head(PRESETS / f"{preset}.yaml").time) < 2


def _seconds(text):
    units = {"s": 1, "min": 60, "h": 3600}
    return sum(int(number) * units[unit] for number, unit in re.findall(r"([0-9]+) (s|min|h)\b", text))


def test_a_narrow_terminal_shortens_no_name_of_a_preset(monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setenv("FORCE_COLOR", "1")
    status, output, _ = invoke("presets")
    assert status == 0 and all(name in output for name in preset_names())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("run", "smoek", "--dry-run"), "did you mean 'smoke'?"),
        (("run", "smoke", "--dry-run", "--set", "num_synthetik=3"), "did you mean 'num_synthetic'?"),
        (("plan", "smoke", "--set", "dataset.name=foldr"), "did you mean 'folder'?"),
        (("run", "smoke", "--preset", "pose"), "two presets are named"),
        (
            ("plan", "demo", "--set", "experiments.pos.seed=3"),
            "no experiment 'pos'; did you mean 'pose'?; the preset has",
        ),
        (
            ("plan", "smoke", "--home", "~no.such.user/x"),
            "'~no.such.user/x': the home folder of that user is not known",
        ),
        (("prune", "--apply", "--home", ""), "expected a folder or a URL, got ''"),
        (("runn",), "Did you mean 'run'"),
        (("run", "--dry-rum"), "--dry-run"),
    ],
)
def test_what_is_misspelt_is_answered_with_the_nearest_name(tmp_path, monkeypatch, arguments, message):
    monkeypatch.setenv("CTLEV_HOME", str(tmp_path))
    status, output, errors = invoke(*arguments)
    assert status == 2 and "Traceback" not in errors
    assert message in re.sub(r"[│\s]+", " ", output + errors)


def test_show_finds_reports(tmp_path):
    status, _, errors = invoke("show", "--home", str(tmp_path))
    assert status == 2 and "holds no report yet" in errors
    folder = tmp_path / "reports"
    folder.mkdir()
    for age, name in enumerate(("demo", "smoke")):
        (folder / f"{name}.html").write_text("page")
        os.utime(folder / f"{name}.html", (age, age))
    for asked, found in (((), "smoke"), (("demo",), "demo"), ((str(folder / "demo"),), "demo")):
        status, output, _ = invoke("show", *asked, "--home", str(tmp_path))
        assert (status, output.strip()) == (0, str(folder / f"{found}.html"))
    status, _, errors = invoke("show", "d" * 300, "--home", str(tmp_path))
    assert status == 2 and "has no report" in errors
    status, _, errors = invoke("show", "demoo", "--home", str(tmp_path))
    assert status == 2 and "did you mean 'demo'?; it has demo, smoke" in errors


def imported(folder, *arguments, of):
    """Which of some packages a command of ours, which must succeed, has imported at its end."""
    code = (
        "import sys; from flows import cli\n"
        "try: cli.app(sys.argv[1:])\n"
        "except SystemExit as end: assert not end.code\n"
        "print(*sys.modules, file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
        check=True,
    )
    (modules,) = done.stderr.splitlines()
    return set(of) & set(modules.split())


@pytest.mark.parametrize("preset", ["smoke", "objects", "body"])
def test_a_plan_imports_neither_torch_nor_prefect(tmp_path, preset):
    slow = ("torch", "prefect", "diffusers", "transformers")
    assert not imported(tmp_path, "plan", preset, "--home", "home", of=slow)


def test_start_up_is_quick_and_imports_neither_torch_nor_prefect(tmp_path):
    for arguments in (["--help"], ["presets"]):
        times = []
        for _ in range(3):
            started = time.perf_counter()
            slow = imported(tmp_path, *arguments, of=("torch", "prefect", "numpy", "pyarrow"))
            times.append(time.perf_counter() - started)
            assert not slow
        assert min(times) < 0.5 * (1 + os.getloadavg()[0]), times  # of an idle machine
    assert not list(tmp_path.iterdir())


def test_files_of_the_users_folder_are_not_imported(tmp_path):
    """Neither by the command nor by the processes that run stages."""
    for name in ("tasks", "flows", "evaluate", "compare", "uvicorn"):
        (tmp_path / f"{name}.py").write_text("raise AssertionError('a file of the user was imported')")
    finished = ctlev("plan", "smoke", "--home", "home", cwd=tmp_path)
    assert finished.returncode == 0, finished.stderr
    code = (
        "import os; from tasks.workers import Workers\n"
        "workers = Workers(1); print(workers.call(os.getpid) != os.getpid()); workers.close()"
    )
    worker = subprocess.run(
        [sys.executable, "-P", "-c", code],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
    )
    assert worker.stdout == "True\n", worker.stderr


@pytest.mark.slow
def test_a_wheel_outside_of_the_repository_is_enough(tmp_path):
    """The command, the presets, the costs and the Python interface, from what `pip` would install."""
    source = tmp_path / "source"
    for name in ("ctlev_core", "data_contracts", "flows", "tasks"):
        shutil.copytree(REPOSITORY / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(REPOSITORY / name, source)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "-w", str(tmp_path), str(source)], check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "site")
    shutil.rmtree(source)
    (entry,) = (tmp_path / "site").glob("*.dist-info/entry_points.txt")
    assert "ctlev = flows.cli:main" in entry.read_text()
    place = {"PYTHONPATH": str(tmp_path / "site")}
    (tmp_path / "tasks.py").write_text("raise AssertionError('a file of the user was imported')")
    plan = ctlev("plan", "smoke", "--home", "home", cwd=tmp_path, **place)
    assert plan.returncode == 0 and "about" in plan.stdout.splitlines()[-1], plan.stderr
    assert "smoke" in ctlev("presets", cwd=tmp_path, **place).stdout
    code = "import ctlev_core as ctlev; print(ctlev.__file__, ctlev.frechet([[0.0], [1]], [[0.0], [1]]))"
    used = [sys.executable, "-P", "-c", code]
    done = subprocess.run(used, cwd=tmp_path, env=os.environ | place, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [str(tmp_path / "site" / "ctlev_core" / "__init__.py"), "0.0"]


IMPORTS = """
import importlib, os, sys
import torch, prefect, transformers, diffusers, cv2  # what these do is theirs
before, argv = dict(os.environ), list(sys.argv)
for name in sys.argv[1].split():
    importlib.import_module(name)
assert dict(os.environ) == before, {k: v for k, v in os.environ.items() if before.get(k) != v}
"""


NEEDS_EXTRA = {"tasks.slurm": "dask_jobqueue"}
"""Modules that are imported only when their runner is asked for, and what they need."""


def test_importing_a_module_changes_nothing(tmp_path):
    names = []
    for package in ("data_contracts", "ctlev_core", "tasks", "flows"):
        path = importlib.import_module(package).__path__
        names += [module.name for module in pkgutil.walk_packages(path, f"{package}.")]
    assert set(names) >= NEEDS_EXTRA.keys()
    for module, needed in NEEDS_EXTRA.items():
        if importlib.util.find_spec(needed) is None:
            names.remove(module)
    done = subprocess.run(
        [sys.executable, "-c", IMPORTS, " ".join(names), "--home", "elsewhere", "--nonesuch"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY), "PREFECT_HOME": str(tmp_path.parent / "prefect")},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert not list(tmp_path.iterdir())


def test_off_a_terminal_a_run_tells_each_stage_and_then_the_answer(tmp_path):
    finished = run_script_here("prepare_dataset", "--preset", "smoke", home=tmp_path)
    assert finished.status == 0, finished.errors
    total, told = told_stages(finished.errors)
    assert [int(one[1]) for one in told] == list(range(1, total + 1))
    assert {one[3] for one in told} == {"ingest", "encode", "condition_frames", "condition_samples", "contact_sheet"}
    answer = finished.output.splitlines()
    assert answer[0].startswith("recordings: ") and answer[-1].startswith(f"{total} stages, 0 of them cached, in ")


def test_a_script_takes_what_it_took(tmp_path):
    finished = run_script("prune", home=tmp_path, own_server=True)  # which it does not start
    assert finished.status == 0 and "0 of 0 folders" in finished.output
