"""What every command does that runs a flow: read a preset, change options, show the plan, run; `flows.cli` parses."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from ctlev_core.duration_text import duration_text
from ctlev_core.plugins import PluginError, validate_options
from data_contracts.errors import DataError, TrainingError, shortened
from data_contracts.experiment import Experiment
from data_contracts.renamed_options import RENAMED_VALUES, name_hint
from data_contracts.study import Study
from data_contracts.yaml_text import load_yaml
from flows import local_server, settings
from flows.costs import HOW_ESTIMATED, estimate_costs
from flows.inputs import InputsMissing, check_inputs, check_recordings
from flows.memory_use import use_memory
from flows.plan_table import print_plan_with_costs
from flows.preset_list import PRESETS, preset_names
from flows.run_progress import shown
from flows.settings import ScriptFlow
from tasks.runners import WorkerError
from tasks.stage import PlannedStage, StageTimeoutError, in_one_run, planning
from tasks.store import Store, home_folder

X = TypeVar("X", bound=Experiment)
_TOLD = (
    DataError,
    PluginError,
    TrainingError,
    ValidationError,
    OSError,
    local_server.ServerLostError,
    StageTimeoutError,
    WorkerError,
)
"""Errors whose message says what a person can do; others are faults of ours."""


def load_experiment(preset: str, overrides: list[str], model: type[X] = Experiment) -> X:
    """The experiment a preset describes, with every plug-in's options validated.

    Args:
        preset: as `load_preset` takes it.
        overrides: likewise.
        model: an experiment, or one with further options.

    Raises:
        PluginError: unknown preset, option or plug-in, a wrong value, or parts that do not go together.
    """
    experiment = load_preset(model, PRESETS, preset, overrides)
    check_inputs(experiment)
    return experiment


def load_preset(model: type[BaseModel], folder: Path, preset: str, overrides: list[str]) -> Any:
    """Read a preset, apply `key=value` overrides and validate it.

    Args:
        model: the options the preset holds.
        folder: of the bundled presets of this kind.
        preset: name of a bundled preset, or path of a YAML file.
        overrides: dotted names, for example `encoding.options.polarity=false`; values are YAML.
    """
    values = read_preset(folder, preset)
    if "experiments" in values:
        parts = ", ".join(str(part.get("extends", name)) for name, part in values["experiments"].items())
        raise PluginError(
            f"preset {preset!r} is a study of several experiments, which full_experiment alone runs; name one of its "
            f"parts instead: {parts}"
        )
    for override in overrides:
        apply_override(values, override)
    return validate_options(model, values, f"preset {preset!r}")


def read_preset(folder: Path, preset: str, heirs: tuple[str, ...] = ()) -> dict[str, Any]:
    """The options of a preset over those of the one it `extends`; each option at the top replaces the other whole."""
    path = Path(preset) if preset.endswith((".yaml", ".yml")) else folder / f"{preset}.yaml"
    if not path.is_file():
        known = ", ".join(preset_names(folder))
        of = f"{heirs[-1]} extends an " if heirs else ""
        hint = name_hint(preset, preset_names(folder), RENAMED_VALUES)
        raise PluginError(f"{of}unknown preset {preset!r}{hint}; known: {known}, or the path of a .yaml file")
    try:
        values = load_yaml(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise PluginError(f"{path}: not a preset in YAML: {error}") from None
    if not isinstance(values, dict):
        raise PluginError(f"{path}: a preset is a mapping of options, got {type(values).__name__}")
    extended = values.pop("extends", None)
    if extended is None:
        return values
    if not isinstance(extended, str) or extended in (*heirs, preset):
        raise PluginError(f"{path}: extends must name another preset, got {shortened(repr(extended), 200)}")
    return read_preset(folder, extended, (*heirs, preset)) | values


def apply_override(values: dict[str, Any], override: str) -> None:
    """Change one option in place.

    Args:
        values: options by name, groups as mappings.
        override: `dotted.name=value`; the value is YAML. A part `*` of the name stands for each of the groups that are
            there: `experiments.*.num_synthetic=100`.
    """
    name, separator, text = override.partition("=")
    if not separator or not name:
        raise PluginError(f"--set expects key=value, got {shortened(repr(override), 200)}")
    *parents, last = name.split(".")
    targets = [values]
    for parent in parents:
        if parent == "*":
            targets = [group for target in targets for group in target.values()]
        else:
            targets = [target.setdefault(parent, {}) for target in targets]
        if not all(isinstance(target, dict) for target in targets):
            raise PluginError(f"--set {name}: {parent!r} is not a group of options")
    for target in targets:
        try:
            target[last] = load_yaml(text)
        except yaml.YAMLError as error:
            raise PluginError(f"--set {name[:100]}: {shortened(repr(text), 100)} is not YAML: {error}") from None


def print_plan(rows: list[PlannedStage]) -> None:
    """One line per stage: cached or to run, and its key."""
    width = max(len(row.label) for row in rows)
    stages = {}
    for row in rows:  # branches of an experiment ask for the same stages
        stages.setdefault(row.key, row)
    for row in stages.values():
        print(f"{'cached' if row.cached else 'to run':7} {row.label:{width}}  {row.key}")
    print(f"{sum(row.cached for row in stages.values())} of {len(stages)} stages are cached")


def publish_plan(rows: list[PlannedStage], description: str) -> None:
    """The same as an artefact of the Prefect run that we are in."""
    from prefect.artifacts import create_table_artifact

    table = [{"stage": row.label, "plan": "cached" if row.cached else "to run", "key": row.key} for row in rows]
    create_table_artifact(table, key="plan", description=description)


def with_plan(script_flow: Any, rows: list[PlannedStage], description: str) -> Any:
    """A flow of one parameter that does what another does, and publishes the plan first."""

    def run(options: Any) -> Any:
        publish_plan(rows, description)
        return script_flow.fn(options)

    run.__name__, run.__doc__ = script_flow.fn.__name__, script_flow.fn.__doc__
    return settings.flow(name=script_flow.name)(run)


def print_costs(asked: Any) -> None:
    """What generators of Stable Diffusion's size would take; nothing for the bundled base model."""
    if not isinstance(asked, Experiment | Study):
        return
    parts = asked.experiments if isinstance(asked, Study) else {asked.name: asked}
    found = {name: cost for name, part in parts.items() if (cost := estimate_costs(part)) is not None}
    if found:
        print(HOW_ESTIMATED)
    for name, cost in found.items():
        print(f"  {name:{max(map(len, found))}}  {cost}")


@dataclass(frozen=True)
class Command:
    """What a flow's script does.

    Attributes:
        flow: of one parameter, its options.
        describe: from the flow's result and its options to the lines printed at the end.
        load: from a preset's name and overrides to the options.
        foretell: from the options to what a dry run says of files outside the store; empty = nothing.
    """

    flow: ScriptFlow[..., Any]
    describe: Callable[[Any, Any], str]
    load: Callable[[str, list[str]], Any] = load_experiment
    foretell: Callable[[Any], str] = lambda _: ""


@dataclass(frozen=True)
class Asked:
    """What a person asked of a command.

    Attributes:
        preset: name of a bundled preset, or path of a .yaml file.
        overrides: options to change, each as `key=value`.
        dry_run: print the plan and run nothing.
        costs: the plan has the time, memory and disk of each stage.
        track: experiment tracker that is told of the finished report; empty = none.
    """

    preset: str
    overrides: list[str]
    dry_run: bool = False
    costs: bool = False
    track: str = ""


def run_command(command: Command, asked: Asked) -> int:
    """Run a flow as a script does; `flows.settings.configure` was called.

    Returns:
        Exit status: 0 done, 2 wrong input, or something that the run needs was lost (a file, the server, a process, its
        time), 130 interrupted, 143 ended by SIGTERM.
    """
    started = time.perf_counter()
    with contextlib.suppress(ValueError):  # in a thread of another program
        signal.signal(signal.SIGTERM, _terminate)
    flow = command.flow
    try:
        home = home_folder()
        check_home(home)
        if not asked.dry_run:
            local_server.start(home)  # first of all, so that what comes now overlaps with its start-up
        Store(home).connect(send=not asked.dry_run)
        if asked.track:
            from flows.tracking import check_tracker, track  # here, because few runs are tracked

            check_tracker(asked.track)
        options = command.load(asked.preset, asked.overrides)
        with planning() as rows:
            flow.fn(options)
        if asked.dry_run:
            if isinstance(options, Experiment | Study):
                check_recordings(options)
            (partial(print_plan_with_costs, home=home) if asked.costs else print_plan)(rows)
            print_costs(options)
            if foretold := command.foretell(options):
                print(foretold)
            return 0
        Store(home).fetch_planned((row.stage, row.key) for row in rows if row.cached)
        use_memory(rows, home)
        all_cached = all(row.cached for row in rows)
        # What is to come is said first: in a new home the server needs ten seconds.
        shows, modules = (in_one_run(), ()) if all_cached else (shown(rows, home), ("torch",))
        with shows, local_server.connected(*modules):
            result = with_plan(flow, rows, f"preset {asked.preset}, in {home}")(options)
        print(command.describe(result, options), flush=True)  # what is done is said, whatever becomes of the rest
        Store(home).send_files()
        if asked.track:
            print(track(asked.track, result.path, options, home))
    except _TOLD as error:
        if isinstance(error, InputsMissing) and asked.dry_run:
            print_costs(error.asked)
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as error:
        how, status = ("ended by SIGTERM", 143) if isinstance(error, _Terminated) else ("interrupted", 130)
        print(f"{how}; finished stages and checkpoints are kept", file=sys.stderr)
        return status
    stages = {row.key: row.cached for row in rows}
    took = duration_text(time.perf_counter() - started)
    print(f"{len(stages)} stages, {sum(stages.values())} of them cached, in {took}")
    return 0


class _Terminated(KeyboardInterrupt):
    """As Ctrl-C, asked for by SIGTERM."""


def _terminate(number: int, frame: object) -> None:
    raise _Terminated


def check_home(home: Path) -> None:
    """Raise `PermissionError` where the home folder cannot be written."""
    if not os.access(home, os.W_OK | os.X_OK):
        raise PermissionError(f"{home}: the home folder cannot be written; choose another with --home or CTLEV_HOME")
