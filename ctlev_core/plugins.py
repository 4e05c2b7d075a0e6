"""A plug-in is a module: one file in its folder, or a module that an installed package offers, found by its name.

What a module must have is said by the Protocols of `ctlev_core.plugin_contracts`. Packages offer theirs by entry points
of the groups `ctlev.datasets`, `ctlev.formats` and so on.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import pkgutil
import re
import reprlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from data_contracts.config import Choice
from data_contracts.errors import MAX_MESSAGE, DataError, shortened
from data_contracts.renamed_options import RENAMED_VALUES, name_hint

KINDS = ("datasets", "formats", "motions", "encodings", "conditions", "generators", "downstream", "metrics")


class PluginError(ValueError):
    """An unknown plug-in or a wrong option."""

    def __init__(self, message: str = "", limit: int = MAX_MESSAGE) -> None:
        super().__init__(shortened(message, limit))


@dataclass(frozen=True)
class Plugin:
    """A loaded plug-in together with its validated options."""

    kind: str
    name: str
    module: Any
    options: Any

    @property
    def version(self) -> int:
        """The module's VERSION."""
        return self.module.VERSION


def names(kind: str) -> list[str]:
    """Names of all plug-ins of a kind, sorted."""
    if kind not in KINDS:
        raise PluginError(f"unknown plug-in kind {kind!r}; known kinds: {', '.join(KINDS)}")
    package = importlib.import_module(f"ctlev_core.{kind}")
    bundled = {module.name for module in pkgutil.iter_modules(package.__path__) if not module.name.startswith("_")}
    if both := sorted(bundled & set(installed(kind))):
        raise PluginError(f"{kind}/{both[0]}: offered by {installed(kind)[both[0]]}, and bundled; one must be renamed")
    return sorted(bundled | set(installed(kind)))


@cache
def installed(kind: str) -> dict[str, str]:
    """Module of each plug-in of a kind that installed packages offer, by name.

    Raises:
        PluginError: a name that none can have, or two packages offer one of the same name.
    """
    found: dict[str, str] = {}
    for entry in importlib.metadata.entry_points(group=f"ctlev.{kind}"):
        if not entry.name.isidentifier() or entry.name.startswith("_") or entry.attr:
            raise PluginError(
                f"{kind}: entry point {entry.name} = {entry.value!r}: expected NAME = MODULE, the name an identifier"
            )
        if found.setdefault(entry.name, entry.module) != entry.module:
            raise PluginError(f"{kind}/{entry.name}: offered by {found[entry.name]} and by {entry.module}")
    return found


def _module_of(kind: str, name: str) -> str:
    return installed(kind).get(name, f"ctlev_core.{kind}.{name}") if kind in KINDS else ""


@cache
def versions(kind: str) -> dict[str, int]:
    """VERSION of every plug-in of a kind, by name; read as text, for to import all of them takes seconds.

    Raises:
        PluginError: a module does not say its VERSION as a number of its own line.
    """
    found = {}
    for name in names(kind):
        spec = importlib.util.find_spec(_module_of(kind, name))
        text = "" if spec is None or spec.origin is None else Path(spec.origin).read_text(encoding="utf-8")
        match = re.search(r"^VERSION = (\d+)", text, re.MULTILINE)
        if match is None:
            raise PluginError(f"{kind}/{name}: expected a line 'VERSION = number' in its module")
        found[name] = int(match[1])
    return found


def recognise(formats: Mapping[str, ModuleType], path: Path) -> ModuleType | None:
    """The one of `formats` whose `sniff` recognises the content of `path`; None where none does.

    Formats with a signature are asked first, all of them; those without only where no signature is found.

    Raises:
        DataError: the file cannot be read, or several formats recognise it.
    """
    for has_signature in (True, False):
        asked = [name for name in formats if has_signature == formats[name].HAS_SIGNATURE]
        try:
            claims = [name for name in asked if formats[name].sniff(path)]
        except OSError as error:
            raise DataError(f"{path}: cannot be read: {error}") from error
        if len(claims) > 1:
            raise DataError(f"{path}: could be any of the formats {', '.join(claims)}; expected exactly one to fit")
        if claims:
            return formats[claims[0]]
    return None


def load(kind: str, name: str) -> ModuleType:
    """Import the module of a plug-in: `ctlev_core.<kind>.<name>`, or that of an installed package.

    Raises:
        PluginError: there is no such plug-in, then the message lists the known ones; or it lacks what its kind has.
    """
    path = _module_of(kind, name)
    # The names are not listed once more for one that was loaded before, which plans would do a thousand times.
    if not (kind in KINDS and name.isidentifier() and not name.startswith("_") and path in sys.modules):
        known = names(kind)
        if name not in known:
            hint = name_hint(name, known, RENAMED_VALUES)
            raise PluginError(f"unknown plug-in {name!r} in {kind}{hint}; known: {', '.join(known)}")
    module = importlib.import_module(path)  # which waits where another thread has begun to import it
    _check_contract(kind, module)
    return module


@cache  # of modules that keep it: one that does not is refused whenever it is loaded
def _check_contract(kind: str, module: ModuleType) -> None:
    from ctlev_core.plugin_contracts import missing_names

    protocol, missing = missing_names(kind, module)
    if missing:
        raise PluginError(
            f"{module.__file__}: expected the names of {protocol} in ctlev_core/plugin_contracts.py, "
            f"lacks {', '.join(missing)}"
        )


def validate_options(model: type[BaseModel], values: Mapping[str, Any], where: str) -> Any:
    """Validate `values` against an options model; every problem becomes one line of one error."""
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        lines = []
        for problem in error.errors():
            option = ".".join(str(part) for part in problem["loc"])
            if problem["type"] == "extra_forbidden":
                known = _options_at(model, problem["loc"][:-1])
                hint = name_hint(str(problem["loc"][-1]), known)
                lines.append(f"unknown option {option!r}{hint}; known: {', '.join(known)}")
            elif problem["type"] == "path_type":
                lines.append(f"option {option!r} must be a path, got {_show(problem['input'])}; --set ...{option}=PATH")
            elif problem["type"] == "value_error" and isinstance(problem["input"], Mapping):
                # Options that do not go together: the message names them, and all of them would bury it.
                lines.append((f"option {option!r}: " if option else "") + problem["msg"].removeprefix("Value error, "))
            else:
                told = problem["msg"][:1].lower() + problem["msg"][1:300]  # what it expects may be upper case
                lines.append(f"option {option!r}: {told}, got {_show(problem['input'])}{_hint(problem)}")
        raise PluginError(f"{where}: " + "; ".join(lines)) from None


_repr = reprlib.Repr()
_repr.maxstring = _repr.maxother = 200
_show = _repr.repr
"""As `repr`, of as much of a value as a message has room for."""


def _hint(problem: Any) -> str:
    """What a value that is not among those of its option is called now; empty where nobody knows."""
    new = RENAMED_VALUES.get(problem["input"]) if isinstance(problem["input"], str) else None
    known = new is not None and problem["type"] == "literal_error" and repr(new) in problem["ctx"]["expected"]
    return f"; {problem['input']!r} is now {new!r}" if known else ""


def _options_at(model: Any, path: Sequence[int | str]) -> list[str]:
    """Names of the options of a model, or of that of its parts which `path` leads to."""
    for step in path:
        fields = getattr(model, "model_fields", {})
        model = fields[step].annotation if step in fields else model  # else an entry of a mapping or sequence
        while not hasattr(model, "model_fields"):
            inner = [part for part in get_args(model) if part not in (str, int, type(None), Ellipsis)]
            if not inner:
                return []
            model = inner[0]
    return list(getattr(model, "model_fields", {}))


def load_options(choice: Choice) -> Plugin:
    """Load the plug-in a preset names and validate its options.

    Raises:
        PluginError: unknown plug-in, unknown option or a wrong value, before anything is computed.
    """
    module = load(choice.KIND, choice.name)
    model = getattr(module, choice.OPTIONS)
    options = validate_options(model, choice.options, f"{choice.KIND} {choice.name!r}")
    return Plugin(choice.KIND, choice.name, module, options)
