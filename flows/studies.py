"""Presets of several experiments: a `Study`, put together from other presets."""

from __future__ import annotations

import re
from copy import deepcopy
from typing import Any

from ctlev_core.plugins import PluginError, validate_options
from data_contracts.experiment import Experiment
from data_contracts.study import Study
from flows.command_line import PRESETS, apply_override, load_experiment, read_preset
from flows.inputs import check_inputs
from flows.speed_vs_error import speed_vs_error_of


def load_study(preset: str, overrides: list[str]) -> Experiment | Study:
    """The experiment a preset describes, or the study of several where it has `experiments`.

    Each of a study's `experiments` `extends` a preset, changes whole options, and single ones under `set`, as
    `key=value`. There `{NAME}` stands for what the study's `paths` say of NAME, so that a folder that several
    experiments need is named once; one that is not given is looked for as `paths.NAME`. `{NAME?}` stands for a folder
    that may be missing: it is null where that path is not given.

    Args:
        preset: as `load_preset` takes it.
        overrides: likewise; those of a study begin with `experiments.NAME.`, `paths.` or `speed_vs_error.`.

    Raises:
        PluginError: as `load_experiment` and `speed_vs_error_of`.
    """
    values = read_preset(PRESETS, preset)
    parts, paths = values.get("experiments"), values.pop("paths", {})
    if parts is None:
        return load_experiment(preset, overrides)
    where = f"preset {preset!r}"
    if not isinstance(parts, dict) or not all(isinstance(part, dict) for part in parts.values()):
        raise PluginError(f"{where}: experiments must be a mapping of names to options, got {parts!r}")
    given, others = ([o for o in overrides if o.startswith("paths.") == is_path] for is_path in (True, False))
    for override in given:
        name = override.partition("=")[0].removeprefix("paths.")
        if name not in paths:
            raise PluginError(f"--set paths.{name}: this preset has no such path; it has {', '.join(paths) or 'none'}")
        apply_override(paths, override.removeprefix("paths."))
    # Copies: what YAML's anchors repeat is one object, and `set` changes it in place.
    values["experiments"] = {
        name: _part(deepcopy(part), paths, f"{where}, experiments.{name}") for name, part in parts.items()
    }
    for override in others:
        apply_override(values, override)
    study = validate_options(Study, values, where)
    check_inputs(study, thoroughly=None in paths.values())
    speed_vs_error_of(study)
    return study


def _part(part: dict[str, Any], paths: dict[str, Any], where: str) -> dict[str, Any]:
    """The options of one experiment of a study."""
    extended, changes = part.pop("extends", None), part.pop("set", [])
    if not isinstance(changes, list) or not all(isinstance(change, str) for change in changes):
        raise PluginError(f"{where}: set must be a list of texts key=value, got {changes!r}")
    values = ({} if extended is None else read_preset(PRESETS, str(extended), (where,))) | part
    for change in changes:
        apply_override(values, _filled(change, paths, where))
    return values


def _filled(change: str, paths: dict[str, Any], where: str) -> str:
    def place(match: re.Match[str]) -> str:
        if match[1] not in paths:
            raise PluginError(f"{where}: {change!r} names no path of this preset; it has {', '.join(paths) or 'none'}")
        given = paths[match[1]]
        if given is None and match[2]:
            return "null"
        return f"'{f'paths.{match[1]}' if given is None else given}'"  # nothing lies there, and errors say its name

    return re.sub(r"\{(\w+)(\??)\}", place, change)
