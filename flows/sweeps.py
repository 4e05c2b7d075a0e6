"""Several values of an option at once: `--set num_synthetic=200,400,800` asks for an experiment of each.

A comma inside brackets or quotes belongs to a value, and so does one in an option that is free text or a path.
"""

from __future__ import annotations

import itertools
import re
import types
from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any, Union, get_args, get_origin

import yaml
from pydantic import BaseModel

from ctlev_core import plugins
from ctlev_core.plugins import PluginError
from data_contracts.config import Choice
from data_contracts.experiment import Experiment
from data_contracts.yaml_text import load_yaml
from flows.command_line import apply_override

MAX_EXPERIMENTS = 200


def split_values(text: str) -> list[str]:
    """The parts of a text between commas that stand in no brackets and no quotes; a single one where there are none."""
    parts, depth, quote = [""], 0, ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "'\"":
            quote = letter
        elif letter in "[{(":
            depth += 1
        elif letter in ")}]":
            depth -= 1
        elif letter == "," and depth == 0:
            parts.append("")
            continue
        parts[-1] += letter
    return [part.strip() for part in parts] if all(part.strip() for part in parts) else [text]


def find_sweeps(values: Mapping[str, Any], overrides: list[str]) -> dict[str, list[str]]:
    """The overrides of an experiment that give several values, by option.

    Args:
        values: of the experiment, without the overrides.
        overrides: each as `key=value`.

    Returns:
        The values of each, as texts.
    """
    several, changed = {}, deepcopy(dict(values))
    for override in overrides:
        name, _, text = override.partition("=")
        parts = split_values(text)
        if len(parts) > 1:
            several[name] = parts
        else:
            several.pop(name, None)  # the last word on an option counts
            apply_override(changed, override)  # it may name the plug-in whose option has several values
    types_of = {name: _annotation(Experiment, changed, name.split(".")) for name in several}
    return {name: parts for name, parts in several.items() if _is_sweep(types_of[name], parts)}


def expand_sweeps(sweeps: Mapping[str, list[str]]) -> dict[str, list[str]]:
    """The overrides of each combination of the values, by a name of it such as `num_synthetic_200`.

    Raises:
        PluginError: a value is there twice, or there are more than `MAX_EXPERIMENTS` combinations.
    """
    found: dict[str, list[str]] = {}
    for chosen in itertools.product(*sweeps.values()):
        pairs = list(zip(sweeps, chosen, strict=True))
        own = "-".join(f"{_short(option)}_{value}" for option, value in pairs)
        label = re.sub(r"[^A-Za-z0-9.-]+", "_", own).strip("_")
        if label in found:
            raise PluginError(f"--set {pairs[-1][0]}: two experiments would be called {label!r}; values must differ")
        found[label] = [f"{option}={value}" for option, value in pairs]
        if len(found) > MAX_EXPERIMENTS:
            raise PluginError(f"--set: {', '.join(sweeps)} give more than {MAX_EXPERIMENTS} experiments")
    return found


def _short(option: str) -> str:
    """`generator_num_steps` of `generator.options.num_steps`: other parts have options of the same name."""
    first, *rest = option.split(".")
    return f"{first}_{rest[-1]}" if rest else first


def study_of(values: Mapping[str, Any], overrides: list[str], sweeps: Mapping[str, list[str]]) -> dict[str, Any]:
    """Options of the study of a sweep.

    Args:
        values: of the preset.
        overrides: all that were asked for.
        sweeps: those with several values.
    """
    common = deepcopy(dict(values))
    for override in overrides:
        if override.partition("=")[0] not in sweeps:
            apply_override(common, override)
    name, experiments = common.get("name"), {}
    for label, changes in expand_sweeps(sweeps).items():
        experiments[label] = deepcopy(common)
        for change in changes:
            apply_override(experiments[label], change)
        experiments[label]["name"] = f"{name}_{label}"
    own = re.sub(r"[^A-Za-z0-9.-]+", "_", "-".join(f"{_short(o)}_{'_'.join(v)}" for o, v in sweeps.items()))
    return {
        "name": f"{name}_{own}"[:100].strip("_"),
        "data_notice": common.get("data_notice", ""),
        "experiments": experiments,
    }


def looks_like_sweep(text: str) -> bool:
    """Are there several values, none of which is text?"""
    return len(parts := split_values(text)) > 1 and not any(isinstance(_read(part), str) for part in parts)


def _is_sweep(annotation: Any, parts: list[str]) -> bool:
    if annotation is None:  # an option nobody knows, or one of a mapping of anything
        return not any(isinstance(_read(part), str) for part in parts)
    return not _takes_text(annotation)


def _read(text: str) -> Any:
    try:
        return load_yaml(text)
    except yaml.YAMLError:
        return text


def _takes_text(annotation: Any) -> bool:
    if get_origin(annotation) in (Union, types.UnionType):
        return any(_takes_text(one) for one in get_args(annotation))
    return annotation in (str, Path)


def _annotation(model: Any, values: Any, path: list[str]) -> Any:
    """The type of an option, None where it is not known; of the name of a plug-in it is `Choice`."""
    values = values if isinstance(values, Mapping) else {}
    first, *rest = path
    if first == "sampling" and rest and "generator" in getattr(model, "model_fields", {}):
        return _of_plugin("generators", "SampleOptions", values.get("generator"), values.get(first), rest)
    field = getattr(model, "model_fields", {}).get(first)
    if field is None:
        return None
    if not rest:
        return field.annotation
    inner, given = field.annotation, values.get(first)
    while get_origin(inner) in (Union, types.UnionType, dict):
        if get_origin(inner) is dict:
            if not rest[1:]:
                return None
            given, rest = (given or {}).get(rest[0]) if isinstance(given, Mapping) else None, rest[1:]
        inner = next((one for one in get_args(inner) if one not in (str, type(None))), None)
    if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
        return None
    if issubclass(inner, Choice):
        if rest == ["name"]:
            return Choice
        options = given.get("options") if isinstance(given, Mapping) else None
        return _of_plugin(inner.KIND, inner.OPTIONS, given, options, rest[1:])
    return _annotation(inner, given, rest)


def _of_plugin(kind: str, model: str, choice: Any, values: Any, path: list[str]) -> Any:
    name = choice.get("name") if isinstance(choice, Mapping) else None
    if not path or name not in plugins.names(kind):
        return None
    return _annotation(getattr(plugins.load(kind, name), model, None), values, path)
