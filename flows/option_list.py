"""Every option of a preset or a plug-in, with type, default and description, read from the options models."""

from __future__ import annotations

import sys
import types
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from ctlev_core import plugins
from ctlev_core.plugins import PluginError
from data_contracts.config import Choice
from data_contracts.experiment import Experiment
from data_contracts.realism_chain import RealismChain
from data_contracts.regeneration import Regeneration
from data_contracts.renamed_options import RENAMED_VALUES, name_hint
from data_contracts.speed_vs_error import SpeedVsErrorOptions
from data_contracts.study import Study
from data_contracts.synthesis import Synthesis
from flows.preset_list import PRESETS, preset_names

OF_KIND = {
    "datasets": "dataset",
    "encodings": "encoding",
    "conditions": "condition",
    "generators": "generator",
    "downstream": "downstream",
    "metrics": "metrics",
}
"""Where an experiment names a plug-in of a kind."""
MAX_VALUE = 60
"""Characters of a value that are shown."""
_EXTENDED = {"synthesize": Synthesis, "regenerate": Regeneration, "realism-chain": RealismChain}


@dataclass(frozen=True)
class Option:
    """One option: its dotted name, as after `--set`, and texts of its type, value and description.

    Attributes:
        default: of the model; empty where one must be given.
        value: that of the preset, where it sets one.
    """

    name: str
    type: str
    default: str
    value: str | None
    description: str


def print_options(name: str) -> int:
    """Print the options of a preset or plug-in; exit status: 0 done, 2 there is none of that name."""
    from flows.tables_of_text import print_table

    try:
        sections = list(options_of(name))
    except PluginError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for title, found in sections:
        rows = [
            [one.name, one.type, _short(one.default if one.value is None else f"{one.value} (preset)"), one.description]
            for one in found
        ]
        print_table(title, ["option", "type", "default", "description"], rows)
    return 0


def _short(text: str) -> str:
    return text if len(text) <= MAX_VALUE else f"{text[: MAX_VALUE - 3]}..."


def options_of(name: str) -> Iterator[tuple[str, list[Option]]]:
    """Sections of options: a title, and the options.

    Args:
        name: of a preset (`pose`, `small`, `speed_vs_error/pose`), or of a plug-in (`controlnet`, `datasets/folder`).

    Raises:
        PluginError: there is neither of that name, or the preset cannot be read.
    """
    kind, _, plugin = name.rpartition("/")
    if kind in plugins.KINDS:
        plugins.load(kind, plugin)  # says what is known where this is not
        yield from _of_plugin(kind, plugin)
        return
    if name.endswith((".yaml", ".yml")) or (PRESETS / f"{name}.yaml").is_file():
        yield from _of_preset(name)
        return
    kinds = [kind for kind in plugins.KINDS if name in plugins.names(kind)]
    folders = [folder for folder in _FOLDERS if name in preset_names(PRESETS / folder)]
    if not kinds and folders:
        yield from _of_preset(f"{folders[0]}/{name}")
        return
    if not kinds:
        presets = preset_names() + [f"{folder}/{one}" for folder in _FOLDERS for one in preset_names(PRESETS / folder)]
        known = [*presets, *(one for kind in plugins.KINDS for one in plugins.names(kind))]
        raise PluginError(
            f"there is no preset or plug-in {name!r}{name_hint(name, known, RENAMED_VALUES)}; `ctlev presets` lists "
            f"presets, `ctlev options PRESET` the plug-ins it uses; kinds of plug-ins: {', '.join(plugins.KINDS)}"
        )
    for found in kinds:
        yield from _of_plugin(found, name)


def option_names() -> list[str]:
    """Dotted names of the options that every experiment has; those of its plug-ins depend on the preset."""
    return [option.name for option in _walk(Experiment, {}, "")]


def _of_plugin(kind: str, name: str) -> Iterator[tuple[str, list[Option]]]:
    module = plugins.load(kind, name)
    prefix = OF_KIND.get(kind, "")
    for model, place in (("Options", f"{prefix}.options."), ("SampleOptions", "sampling.")):
        if hasattr(module, model) and prefix:
            place = "" if kind == "metrics" else place  # entries of a list have no name of their own
            yield f"{kind}/{name}: {_first_line(module)}", list(_walk(getattr(module, model), {}, place))
    if not hasattr(module, "Options"):
        yield f"{kind}/{name}: {_first_line(module)}", []


def _of_preset(name: str) -> Iterator[tuple[str, list[Option]]]:
    from flows.command_line import read_preset

    folder, _, own = name.rpartition("/")
    if folder in _FOLDERS and not Path(name).is_file():
        yield f"preset {name}", list(_walk(_FOLDERS[folder](), read_preset(PRESETS / folder, own), ""))
        return
    values = read_preset(PRESETS, name)
    if "experiments" in values:
        paths = values.get("paths") or {}
        yield (
            f"study {name}",
            [Option(f"paths.{one}", "path or null", "", _text(value), "") for one, value in paths.items()]
            + [option for option in _walk(Study, values, "") if not option.name.startswith("experiments")],
        )
        parts = [
            Option(f"experiments.{one}.", "experiment", "", None, f"see `ctlev options {part.get('extends', one)}`")
            for one, part in values["experiments"].items()
        ]
        yield f"experiments of {name}", parts
        return
    yield f"preset {name}", list(_walk(Experiment, values, ""))
    for command, model in _EXTENDED.items():
        own_fields = [field for field in model.model_fields if field not in Experiment.model_fields]
        found = [option for option in _walk(model, values, "") if option.name.partition(".")[0] in own_fields]
        yield f"also, with `ctlev {command} {name}`", found


def _pretraining() -> type[BaseModel]:
    from ctlev_core.diffusion.pretraining.pretraining import PretrainingOptions

    return PretrainingOptions


_FOLDERS: dict[str, Callable[[], type[BaseModel]]] = {
    "pretraining": _pretraining,
    "speed_vs_error": lambda: SpeedVsErrorOptions,
}


def _walk(model: type[BaseModel], values: Mapping[str, Any], prefix: str) -> Iterator[Option]:
    """Options of a model and of the models and plug-ins in it, with the values that a preset gives."""
    for name, field in model.model_fields.items():
        given, full = values.get(name), f"{prefix}{name}"
        inner = _model_in(field.annotation)
        if inner is not None and issubclass(inner, Choice):
            yield _option(full, field, values, "name", inner)
            if isinstance(given, Mapping) and "name" in given:
                yield from _of_choice(inner, given["name"], given.get("options") or {}, f"{full}.options.")
        elif inner is not None and _is_mapping(field.annotation) and isinstance(given, Mapping):
            for key, value in given.items():
                yield from _walk(inner, value if isinstance(value, Mapping) else {}, f"{full}.{key}.")
        elif inner is not None and not _is_mapping(field.annotation):
            yield from _walk(inner, given if isinstance(given, Mapping) else {}, f"{full}.")
        elif name == "sampling" and "generator" in model.model_fields:
            generator = values.get("generator") or {}
            if isinstance(generator, Mapping) and "name" in generator:
                yield from _of_choice(_Sampling, generator["name"], given or {}, f"{full}.")
            else:
                yield _option(full, field, values)
        else:
            yield _option(full, field, values)


class _Sampling(Choice):
    KIND = "generators"
    OPTIONS = "SampleOptions"


def _of_choice(choice: type[Choice], name: str, values: Mapping[str, Any], prefix: str) -> Iterator[Option]:
    yield from _walk(getattr(plugins.load(choice.KIND, name), choice.OPTIONS), values, prefix)


def _option(
    name: str, field: FieldInfo, values: Mapping[str, Any], part: str = "", choice: type[Choice] | None = None
) -> Option:
    given = values.get(name.rpartition(".")[2], ...)
    if part and isinstance(given, Mapping):
        given = given.get(part, ...)
    value = None if given is ... else _text(given)
    if choice is not None:
        what = f"one of {', '.join(plugins.names(choice.KIND))}" + (" or null" if not field.is_required() else "")
    else:
        what = type_text(field.annotation, field.metadata)
    default = "(required)" if field.is_required() else _text(field.get_default(call_default_factory=True))
    description = field.description or (choice.__doc__ or "").split("\n")[0] if choice else field.description or ""
    return Option(f"{name}.{part}" if part else name, what, default, value if value != default else None, description)


_WORDS = {str: "text", int: "int", float: "float", bool: "true or false", type(None): "null", Path: "path", Any: "any"}
_BOUNDS = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}


def type_text(annotation: Any, metadata: list[Any] | None = None) -> str:
    """A type in words: `int > 0`, `one of count, duration`, `list of text`, `path or null`."""
    bounds = [
        f"{sign} {getattr(one, key)}" for one in metadata or [] for key, sign in _BOUNDS.items() if hasattr(one, key)
    ]
    words = _type_words(annotation)
    bare = words.removesuffix(" or null")
    return " ".join([bare, " and ".join(bounds)]).strip() + words[len(bare) :]


def _type_words(annotation: Any) -> str:
    origin, inner = get_origin(annotation), get_args(annotation)
    if annotation in _WORDS:
        return _WORDS[annotation]
    if origin is Literal:
        return "one of " + ", ".join(map(_text, inner))
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(_type_words(one) for one in inner))
    if origin in (tuple, list) and (len(inner) < 2 or inner[-1] is Ellipsis):
        return f"list of {_type_words(inner[0])}" if inner else "list"
    if origin is tuple:
        return f"[{', '.join(map(_type_words, inner))}]"
    if origin is dict:
        return f"mapping of {_type_words(inner[1])}"
    if isinstance(annotation, type) and issubclass(annotation, Choice):
        return "{name, options}"
    if hasattr(annotation, "__metadata__"):
        return type_text(annotation.__origin__, list(annotation.__metadata__))
    return getattr(annotation, "__name__", str(annotation))


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """The model that an option, or each entry of a mapping, is; None for lists of models and plain values."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if get_origin(annotation) in (Union, types.UnionType, dict):
        return next((found for one in get_args(annotation) if (found := _model_in(one)) is not None), None)
    return None


def _is_mapping(annotation: Any) -> bool:
    return get_origin(annotation) is dict or any(get_origin(one) is dict for one in get_args(annotation))


def _text(value: Any) -> str:
    """A value as `--set` takes it."""
    if isinstance(value, BaseModel):
        return _text({name: getattr(value, name) for name in type(value).model_fields})
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_text, value))}]"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key}: {_text(item)}' for key, item in value.items())}}}"
    return str(value)


def _first_line(module: Any) -> str:
    return (module.__doc__ or "").strip().split("\n")[0]
