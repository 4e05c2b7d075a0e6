"""Pages of the site that are made when it is built: README and its like, every preset, every option.

`mkdocs.yml` names this file as a hook. Nothing it makes is kept in the repository, so that it cannot go out of date.
"""

from __future__ import annotations

import re
import typing
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from flows.option_list import OF_KIND, type_text
from flows.preset_list import PRESETS

REPOSITORY = Path(__file__).resolve().parents[1]
PAGES_OF_FILES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "benchmarks/RESULTS.md": "benchmarks.md",
    "CITATION.cff": "CITATION.cff",
}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made."""
    for source, name in PAGES_OF_FILES.items():
        text = (REPOSITORY / source).read_text(encoding="utf-8")
        files.append(File.generated(config, name, content=with_links_of_the_site(text, source)))
    files.append(File.generated(config, "reference/preset_files.md", content=preset_files()))
    files.append(File.generated(config, "reference/options_experiments.md", content=experiment_options()))
    for kind in OF_KIND:
        files.append(File.generated(config, f"reference/options_{kind}.md", content=plugin_options(kind)))
    return files


def with_links_of_the_site(text: str, source: str) -> str:
    """The text of a file of the repository with its relative links turned to pages of the site."""

    def turn(match: re.Match[str]) -> str:
        path, _, anchor = match[1].partition("#")
        place = (Path(source).parent / path).as_posix()
        target = PAGES_OF_FILES.get(place, place.removeprefix("docs/"))
        return f"]({target}{'#' if anchor else ''}{anchor})"

    return re.sub(r"\]\((?![a-z]+:|#)([^)\s]+)\)", turn, text)


def preset_files() -> str:
    """Every bundled preset as it stands."""
    lines = [
        "# Preset files",
        "",
        "The presets of `flows/presets/`. [Presets](../presets.md) says what each does and how long it takes.",
        "",
    ]
    for folder in ("", "pretraining", "speed_vs_error"):
        if folder:
            lines += [f"## flows/presets/{folder}", ""]
        for path in sorted((PRESETS / folder).glob("*.yaml")):
            lines += [f"{'###' if folder else '##'} {path.stem}", ""]
            lines += ["```yaml", path.read_text(encoding="utf-8").rstrip(), "```", ""]
    return "\n".join(lines)


def experiment_options() -> str:
    """Options of experiments and of what is built of them."""
    from ctlev_core.diffusion.pretraining.pretraining import PretrainingOptions
    from ctlev_core.pixel_decoder.options import PixelDecoderOptions
    from data_contracts.experiment import Experiment
    from data_contracts.realism_chain import RealismChain
    from data_contracts.regeneration import Regeneration
    from data_contracts.speed_vs_error import SpeedVsErrorOptions
    from data_contracts.study import Study
    from data_contracts.synthesis import Synthesis

    text = [
        "# Options of experiments",
        "",
        "Every option of a preset, from the models that check them. Set one with `--set NAME=VALUE`. Options marked "
        "*run setting* change no result and are not part of the cache key.",
        "",
    ]
    common = set(Experiment.model_fields)
    for heading, model, without in (
        ("Experiment", Experiment, set()),
        ("Study", Study, set()),
        ("`flows/synthesize.py`: further options", Synthesis, common),
        ("`flows/regenerate.py`: further options", Regeneration, common),
        ("`flows/realism_chain.py`: further options", RealismChain, common),
        ("`flows/speed_vs_error.py`", SpeedVsErrorOptions, set()),
        ("`flows/pretrain.py`, and `base_model` of an experiment", PretrainingOptions, set()),
        ("`pixel_decoder` of an experiment", PixelDecoderOptions, set()),
    ):
        text += [f"## {heading}", "", *option_tables(model, without, skip=(Experiment,)), ""]
    return "\n".join(text)


def plugin_options(kind: str) -> str:
    """Options of every plug-in of a kind."""
    from ctlev_core import plugins

    where = OF_KIND[kind]
    text = [f"# Options of {kind}", "", f"Set with `--set {where}.options.NAME=VALUE`, or in a preset.", ""]
    if kind == "metrics":
        text[2] = "Set in a preset: `metrics: [{name: oks, options: {...}}]`."
    for name in plugins.names(kind):
        module = plugins.load(kind, name)
        text += [f"## {name}", "", _plain(str(module.__doc__).strip().splitlines()[0]), ""]
        text += [*option_tables(module.Options), ""]
        if hasattr(module, "SampleOptions"):
            text += [f"Sampling of `{name}`: `--set sampling.NAME=VALUE`", "", *option_tables(module.SampleOptions), ""]
    return "\n".join(text)


def option_tables(model: type[BaseModel], without: Iterable[str] = (), skip: tuple[type, ...] = ()) -> Iterator[str]:
    """A table of a model's options, and one of each model that an option holds."""
    rows = {name: field for name, field in model.model_fields.items() if name not in set(without)}
    if not rows:
        yield "No options."
        return
    yield "| option | type | default | meaning |"
    yield "|---|---|---|---|"
    inner: dict[type[BaseModel], str] = {}
    for name, field in rows.items():
        inner |= {found: name for found in _models_in(field.annotation) if found not in inner and found not in skip}
        extra = field.json_schema_extra
        run_setting = " *Run setting.*" if isinstance(extra, dict) and extra.get("run_setting") else ""
        shown = _default(field)
        kind, meaning = _plain(type_text(field.annotation, field.metadata)), _plain(field.description or "")
        yield f"| `{name}` | {kind} | {shown} | {meaning}{run_setting} |"
    for found, name in inner.items():
        yield ""
        yield f"`{name}`, {_plain(str(found.__doc__).strip().splitlines()[0])}"
        yield ""
        yield from option_tables(found, skip=(*skip, found))


def _default(field: Any) -> str:
    if field.is_required():
        return "required"
    value = field.default if field.default is not PydanticUndefined else field.default_factory()
    if isinstance(value, BaseModel):
        return "see below"
    if isinstance(value, tuple | list) and any(isinstance(one, BaseModel) for one in value):
        return ", ".join(f"`{getattr(one, 'name', one)}`" for one in value)
    if value is None:
        return "none"
    text = str(value).lower() if isinstance(value, bool) else str(list(value) if isinstance(value, tuple) else value)
    return f"`{_cell(text)}`" if text else "empty"


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Models within a type, but for plug-in choices, whose options have pages of their own."""
    is_model = isinstance(annotation, type) and issubclass(annotation, BaseModel)
    if is_model and not annotation.__name__.endswith("Choice"):
        yield annotation
    for argument in typing.get_args(annotation):
        yield from _models_in(argument)


def _plain(text: str) -> str:
    """A description as one cell: no line breaks, no bar, no tag; inline code stays."""
    text = _cell(" ".join(text.split()))
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(
        part if part.startswith("`") else re.sub(r"([<*_\[\]])", r"\\\1", part).replace("\\<", "&lt;") for part in parts
    )


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
