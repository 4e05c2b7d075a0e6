"""Presets of several experiments: a `Study`, put together from other presets."""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Mapping
from copy import deepcopy
from typing import Any

from ctlev_core.plugins import PluginError, validate_options
from data_contracts.errors import shortened
from data_contracts.experiment import Experiment
from data_contracts.renamed_options import name_hint
from data_contracts.study import Study
from flows.command_line import PRESETS, apply_override, load_experiment, read_preset
from flows.inputs import check_inputs
from flows.speed_vs_error import speed_vs_error_of
from flows.stand_ins import make_missing
from flows.sweeps import find_sweeps, looks_like_sweep, study_of


def load_study(preset: str, overrides: list[str]) -> Experiment | Study:
    """The experiment a preset describes, or the study of several where it has `experiments`.

    Each of a study's `experiments` `extends` a preset, changes whole options, and single ones under `set`, as
    `key=value`. There `{NAME}` stands for what the study's `paths` say of NAME, so that a folder that several
    experiments need is named once; one that is not given is looked for as `paths.NAME`. `{NAME?}` stands for a folder
    that may be missing: it is null where that path is not given. An experiment that says `only_with` some of the paths
    is left out where one of them is not given, and `data_notice` says so.

    `set` beside `experiments` changes single options of them, as `experiments.NAME.key=value`; `*` as NAME stands for
    every one. `stand_ins` has what `paths` leave open made on the spot, see `flows.stand_ins`.

    Of a preset of one experiment, overrides with several values (`flows.sweeps`) make a study of all combinations.

    Args:
        preset: as `load_preset` takes it.
        overrides: likewise; those of a study begin with `experiments.NAME.`, `paths.`, `speed_vs_error.` or
            `stand_ins=`.

    Raises:
        PluginError: as `load_experiment` and `speed_vs_error_of`.
    """
    values, where = read_preset(PRESETS, preset), f"preset {preset!r}"
    if values.get("experiments") is None:
        sweeps = find_sweeps(values, overrides)
        if not sweeps:
            return load_experiment(preset, overrides)
        study = validate_options(Study, study_of(values, overrides, sweeps), where)
        check_inputs(study)
        return study
    return _load_study(values, overrides, where)


def _load_study(values: dict[str, Any], overrides: list[str], where: str) -> Study:
    """The study that a preset with `experiments` describes; see `load_study`."""
    early, overrides = _split(overrides, "stand_ins=")
    for override in early:
        apply_override(values, override)
    parts, paths, groups, changes = _read_study(values, where)
    parts = _repeat(parts, where)
    _check_changes(changes, parts, where)
    if swept := next((override for override in overrides if looks_like_sweep(override.partition("=")[2])), None):
        raise PluginError(f"--set {swept}: {where} is a study; several values are for presets of one experiment")
    given, others = _split(overrides, "paths.")
    for override in given:
        name = override.partition("=")[0].removeprefix("paths.")
        if name not in paths:
            raise PluginError(f"--set paths.{name}: this preset has no such path; it has {', '.join(paths) or 'none'}")
        apply_override(paths, override.removeprefix("paths."))
    stand_ins = values.pop("stand_ins", None)
    if stand_ins is not None:
        changes = [*changes, *(f"experiments.*.{option}" for option in make_missing(paths, stand_ins, where))]
    wanted = {name: part.get("only_with", []) for name, part in parts.items()}
    left_out = _leave_out(parts, paths, where)
    if left_out:
        values["data_notice"] = " ".join([str(values.get("data_notice", "")), *left_out.values()]).strip()
    # Copies: what YAML's anchors repeat is one object, and `set` changes it in place.
    values["experiments"] = {
        name: _part(deepcopy(part), paths, groups, f"{where}, experiments.{name}") for name, part in parts.items()
    }
    _change(values, changes, left_out)
    for override in others:
        if name := next((name for name in left_out if override.startswith(f"experiments.{name}.")), None):
            raise PluginError(f"--set {override}: {left_out[name]}")
        _check_experiment(override, parts)
        apply_override(values, override)
    study = validate_options(Study, values, where)
    done_without = {path for name in left_out for path in wanted[name]}
    check_inputs(study, thoroughly=any(given is None for path, given in paths.items() if path not in done_without))
    speed_vs_error_of(study)
    return study


def _read_study(
    values: dict[str, Any], where: str
) -> tuple[dict[str, Any], dict[str, Any], dict[str, list[str]], list[str]]:
    """Experiments, paths, groups of options and changes of a preset, taken out of it but for the experiments.

    Raises:
        PluginError: one of them is not of its kind.
    """
    parts, paths, groups = values.get("experiments"), values.pop("paths", {}), values.pop("sets", {})
    changes = values.pop("set", [])
    if not isinstance(parts, dict) or not all(isinstance(part, dict) for part in parts.values()):
        raise PluginError(
            f"{where}: experiments must be a mapping of names to options, got {shortened(repr(parts), 200)}"
        )
    if not isinstance(groups, dict) or not all(_are_texts(group) for group in groups.values()):
        raise PluginError(
            f"{where}: sets must map names to lists of texts key=value, got {shortened(repr(groups), 200)}"
        )
    if not _are_texts(changes):
        raise PluginError(f"{where}: set must be a list of texts key=value, got {shortened(repr(changes), 200)}")
    return parts, paths, groups, changes


def _check_experiment(override: str, parts: Collection[str]) -> None:
    """Raise where an override is of an experiment that a study does not have, which would begin as an empty one."""
    first, *rest = override.partition("=")[0].split(".")
    if first == "experiments" and rest and rest[0] not in ("*", *parts):
        hint = name_hint(rest[0], parts)
        raise PluginError(
            f"--set {override}: there is no experiment {rest[0]!r}{hint}; the preset has {', '.join(parts)}, and * for "
            "all of them"
        )


def _check_changes(changes: list[str], parts: Mapping[str, Any], where: str) -> None:
    starts = tuple(f"experiments.{name}." for name in ("*", *parts))
    if unknown := [change for change in changes if not change.startswith(starts)]:
        raise PluginError(
            f"{where}: set changes options of its experiments, as experiments.NAME.key=value with one of "
            f"{', '.join(parts)} or *; got {shortened(repr(unknown[0]), 200)}"
        )


def _change(values: dict[str, Any], changes: list[str], left_out: Collection[str]) -> None:
    """Apply the changes of a preset in place, but those of what is left out, which is not pooled either."""
    for change in changes:
        if not change.startswith(tuple(f"experiments.{name}." for name in left_out)):
            apply_override(values, change)
    if left_out and isinstance(values.get("pooled"), dict):
        values["pooled"] = {group: [n for n in names if n not in left_out] for group, names in values["pooled"].items()}


def _split(overrides: list[str], start: str) -> tuple[list[str], list[str]]:
    """Those that begin so, and the others."""
    return [one for one in overrides if one.startswith(start)], [one for one in overrides if not one.startswith(start)]


def _repeat(parts: dict[str, Any], where: str) -> dict[str, Any]:
    """The experiments, with one that has `for: {NAME: [values]}` once for each combination of the values.

    `{NAME}` is filled in wherever it stands in the experiment and in its own name.
    """
    found: dict[str, Any] = {}
    for template, part in parts.items():
        repeated = part.get("for", {})
        if not isinstance(repeated, dict) or not all(isinstance(values, list) for values in repeated.values()):
            raise PluginError(
                f"{where}, experiments.{template}: for must map names to lists, got {shortened(repr(repeated), 200)}"
            )
        for values in itertools.product(*repeated.values()):
            chosen = dict(zip(repeated, values, strict=True))
            name, one = _with_values([template, {key: value for key, value in part.items() if key != "for"}], chosen)
            if name in found:
                raise PluginError(
                    f"{where}, experiments.{template}: two experiments are called {name!r}; its name must hold "
                    f"{' and '.join(f'{{{key}}}' for key in repeated) or 'something of its own'}"
                )
            found[name] = one
    return found


def _with_values(value: Any, chosen: dict[str, Any]) -> Any:
    """Everything text in nested mappings and lists with `{NAME}` replaced."""
    if isinstance(value, dict):
        return {key: _with_values(item, chosen) for key, item in value.items()}
    if isinstance(value, list):
        return [_with_values(item, chosen) for item in value]
    if isinstance(value, str):
        return re.sub(r"\{(\w+)\}", lambda match: str(chosen.get(match[1], match[0])), value)
    return value


def _leave_out(parts: dict[str, Any], paths: dict[str, Any], where: str) -> dict[str, str]:
    """Take out the experiments whose `only_with` names a path that is not given; a sentence about each."""
    left_out = {}
    for name, part in list(parts.items()):
        needed = part.pop("only_with", [])
        if not isinstance(needed, list) or not set(needed) <= set(paths):
            raise PluginError(
                f"{where}, experiments.{name}: only_with must be a list of the preset's paths, "
                f"{', '.join(paths) or 'none'}; got {shortened(repr(needed), 200)}"
            )
        if any(paths[path] is None for path in needed):
            needs = " ".join(f"--set paths.{path}=..." for path in needed)
            left_out[name] = f"Left out: `{name}`, which needs {needs}."
            del parts[name]
    return left_out


def _part(part: dict[str, Any], paths: dict[str, Any], groups: dict[str, list[str]], where: str) -> dict[str, Any]:
    """The options of one experiment of a study."""
    extended, changes = part.pop("extends", None), part.pop("set", [])
    if not _are_texts(changes):
        raise PluginError(f"{where}: set must be a list of texts key=value, got {shortened(repr(changes), 200)}")
    values = ({} if extended is None else read_preset(PRESETS, str(extended), (where,))) | part
    for entry in changes:
        if "=" not in entry and entry not in groups:
            hint = name_hint(entry, groups)
            raise PluginError(
                f"{where}: set: {shortened(repr(entry), 200)} is neither key=value nor one of `sets`{hint}"
            )
        for change in groups.get(entry, [entry]):
            apply_override(values, _with_paths(change, paths, where))
    return values


def _are_texts(changes: Any) -> bool:
    return isinstance(changes, list) and all(isinstance(change, str) for change in changes)


def _with_paths(change: str, paths: dict[str, Any], where: str) -> str:
    def place(match: re.Match[str]) -> str:
        if match[1] not in paths:
            known = ", ".join(paths) or "none"
            raise PluginError(f"{where}: {shortened(repr(change), 200)} names no path of this preset; it has {known}")
        given = paths[match[1]]
        if given is None and match[2]:
            return "null"
        return f"'{f'paths.{match[1]}' if given is None else given}'"  # nothing lies there, and errors say its name

    return re.sub(r"\{(\w+)(\??)\}", place, change)
