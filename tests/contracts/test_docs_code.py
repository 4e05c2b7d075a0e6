"""The code of the documentation: commands name presets and options that exist, YAML is valid, Python runs.

Nothing is computed: options are checked by the scripts' own loaders, up to where data would be looked for. The blocks
of docs/extending.md have a test of their own.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import re
import shlex
from pathlib import Path

import pytest
import yaml
from doc_pages import PAGES, REPOSITORY, Block, blocks, inline_code, name_of
from generated_frames import make_generated, make_recorded, make_streams, publish

from ctlev_core import plugins
from ctlev_core.plugins import PluginError
from data_contracts import tables
from data_contracts.config import Frozen
from data_contracts.experiment import Experiment
from data_contracts.study import Study
from flows import command_line, studies
from flows.command_line import PRESETS, load_preset
from flows.stand_ins import make_missing
from tasks.export_images import write_image_folder

LOADERS = {"full_experiment": "load_study"} | {
    name: f"load_{loaded}"
    for name, loaded in {
        "synthesize": "synthesis",
        "regenerate": "regeneration",
        "realism_chain": "realism_chain",
        "speed_vs_error": "speed_vs_error",
    }.items()
}
"""What loads the options of a script; the others take those of an experiment."""
COMMANDS = {
    "run": "full_experiment", "plan": "full_experiment", "synthesize": "synthesize", "prepare": "prepare_dataset",
    "train": "train_generator", "evaluate": "evaluate", "regenerate": "regenerate",
}  # fmt: skip
"""Subcommands of `ctlev` that take a preset, and the scripts they stand for."""
OWN_OPTIONS = {"--preset", "--set", "--dry-run", "--home", "--verbose"}


def check_options(asked: Experiment | Study, *, thoroughly: bool = False) -> None:
    """As `flows.inputs.check_inputs`, without looking for files."""
    for experiment in asked.experiments.values() if isinstance(asked, Study) else [asked]:
        for choice in experiment.choices:
            plugins.load_options(choice)


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """For stand-ins: tiny ones, made once."""
    return tmp_path_factory.mktemp("home")


@pytest.fixture(autouse=True)
def no_data_is_looked_for(home, monkeypatch):
    monkeypatch.setattr(command_line, "check_inputs", check_options)
    monkeypatch.setenv("CTLEV_HOME", str(home))
    monkeypatch.setattr(studies, "make_missing", lambda paths, size, where: make_missing(paths, "tiny", where))
    monkeypatch.setattr(studies, "check_inputs", check_options)


def commands(text: str) -> list[list[str]]:
    """The words of each line that runs a script or `ctlev`; lines that go on are joined, optional parts are taken."""
    found = []
    for line in text.replace("\\\n", " ").splitlines():
        if re.match(r"\s*(python flows/\w+\.py|ctlev [a-z]+)\b", line):
            line = re.sub(r" \[(-[^\[\]]*(?:\[[^\]]*\][^\[\]]*)*)\]", r" \1", line.split("   #")[0])
            found.append(shlex.split(line, comments=False))
    return found


def check_command(words: list[str]) -> bool:
    """Load the options that a command asks for; False where it names none, or those of the reader's own file."""
    if words[0] == "ctlev":
        script, rest = COMMANDS.get(words[1], ""), words[2:]
        if rest and not rest[0].startswith("-"):
            rest = ["--preset", *rest]
    else:
        script, rest = Path(words[1]).stem, words[2:]
        source = (REPOSITORY / words[1]).read_text(encoding="utf-8")
        unknown = [word for word in rest if word.startswith("--") and word not in OWN_OPTIONS and word not in source]
        assert not unknown, f"{words[1]} has no {unknown}"
    given = [rest[i + 1] for i, word in enumerate(rest) if word == "--preset"]
    overrides = [rest[i + 1] for i, word in enumerate(rest) if word == "--set" and not rest[i + 1].startswith("key=")]
    if not script or (given and (given[0].endswith(".yaml") or given[0].isupper())):
        return False
    if script in ("compare", "prune", "verify"):
        return True
    if script == "pretrain":
        from ctlev_core.diffusion.pretraining.pretraining import PretrainingOptions

        load_preset(PretrainingOptions, PRESETS / "pretraining", given[0] if given else "small", overrides)
        return True
    default = {"full_experiment": "demo", "speed_vs_error": "pose"}.get(script, "pose")
    loader = LOADERS.get(script)
    load = getattr(importlib.import_module(f"flows.{script}"), loader) if loader else command_line.load_experiment
    load(given[0] if given else default, overrides)
    return True


COMMAND_BLOCKS = [block for page in PAGES for block in blocks(page, "bash", "") if commands(block.text)]
YAML_BLOCKS = [block for page in PAGES if page.stem != "extending" for block in blocks(page, "yaml")]
PYTHON_BLOCKS = [block for page in PAGES for block in blocks(page, "python")]


@pytest.mark.parametrize("block", COMMAND_BLOCKS, ids=str)
def test_commands_name_presets_and_options_that_exist(block):
    for words in commands(block.text):
        check_command(words)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_in_sentences_do_too(page):
    for code in inline_code(page):
        for words in commands(code):
            check_command(words)


def test_a_wrong_command_is_found():
    assert check_command(shlex.split("python flows/synthesize.py --preset folder --set dataset.options.root=R"))
    for wrong in (
        "python flows/synthesize.py --preset foldr",
        "python flows/synthesize.py --preset pose --set export_foldr=mine",
        "ctlev run pose --set dataset.options.rot=R",
        "python flows/full_experiment.py --set paths.gone=R",
    ):
        with pytest.raises(PluginError):
            check_command(shlex.split(wrong))
    with pytest.raises(AssertionError, match="--keep-dys"):
        check_command(shlex.split("python flows/prune.py --keep-dys 3"))
    assert sum(check_command(words) for block in COMMAND_BLOCKS for words in commands(block.text)) >= 12


def option_names() -> dict[str, set[str]]:
    """Names of options by what stands before them, such as `generator.options`."""
    kinds = {"dataset": "datasets", "poses": "datasets", "target": "datasets", "encoding": "encodings",
             "condition": "conditions", "generator": "generators", "downstream": "downstream"}  # fmt: skip
    found: dict[str, set[str]] = {}
    for kind in set(kinds.values()):
        for name in plugins.names(kind):
            module = plugins.load(kind, name)
            for model, prefixes in (
                ("Options", [f"{part}.options" for part, of in kinds.items() if of == kind]),
                ("SampleOptions", ["sampling"]),
            ):
                fields = set(getattr(getattr(module, model, None), "model_fields", ()))
                for prefix in prefixes:
                    found.setdefault(prefix, set()).update(fields)
    from data_contracts.realism_chain import RealismChain
    from data_contracts.regeneration import Regeneration

    for part, model in {"windows": Experiment, "gates": Regeneration, "chain": RealismChain}.items():
        annotation = model.model_fields[part].annotation
        assert isinstance(annotation, type) and issubclass(annotation, Frozen)
        found[part] = set(annotation.model_fields)
    return found


def test_options_named_in_sentences_exist():
    known, wrong, seen = option_names(), [], 0
    for page in PAGES:
        if page.name == "CHANGELOG.md":
            continue  # it names options of the past
        for code in inline_code(page):
            for prefix, name in re.findall(r"(?<![\w.])(\w+\.options|sampling|windows|gates|chain)\.(\w+)", code):
                seen += 1
                if prefix in known and name not in {*known[prefix], "py", "yaml"}:
                    wrong.append(f"{name_of(page)}: {prefix}.{name}")
            group = re.match(r"(\w+)=[\[{]", code)  # a whole group of options, such as `mixtures=[...]`
            if group and group[1] not in Experiment.model_fields:
                wrong.append(f"{name_of(page)}: {group[1]}")
    assert not wrong and seen > 30


@pytest.mark.parametrize("block", YAML_BLOCKS, ids=str)
def test_yaml_is_part_of_a_preset(block, tmp_path):
    values = yaml.safe_load(block.text)
    if not set(values) & {"experiments", "pooled", "speed_vs_error"}:
        path = tmp_path / "preset.yaml"
        whole = "extends" in values
        path.write_text(block.text if whole else "extends: pose\nname: docs\n" + block.text)
        pictures = ["base_model.pictures.root=R", "generator.options.rehearsal.root=R"] if whole else []
        check_options(load_preset(Experiment, PRESETS, str(path), pictures))
        return
    parts = {"pose": {"extends": "pose", "name": "docs_pose"}}
    path = tmp_path / "study.yaml"
    path.write_text(yaml.safe_dump({"name": "docs", "experiments": parts, **values}))
    roots = [f"experiments.{name}.{root}" for name in _draws(values) for root in _ROOTS]
    assert isinstance(studies.load_study(str(path), roots), Study)


_ROOTS = (
    "dataset.options.root=R", "oracle.dataset.options.root=R", "base_model.pictures.root=R",
    "generator.options.rehearsal.root=R", "baselines.random_weights.generator.options.rehearsal.root=R",
    "baselines.simulator.condition.options.root=R",
)  # fmt: skip
"""What `nmnist_draw` needs and a reader's study would give by `paths`."""


def _draws(values: dict) -> list[str]:
    return [name for group in values.get("pooled", {}).values() for name in group]


@pytest.mark.parametrize("block", PYTHON_BLOCKS, ids=str)
def test_python_compiles_and_its_imports_resolve(block):
    tree = ast.parse(block.text)
    for node in ast.walk(tree):
        modules = [node.module] if isinstance(node, ast.ImportFrom) else []
        modules += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        for module in modules:
            if module and module.split(".")[0] in ("ctlev_core", "data_contracts", "flows", "tasks"):
                assert importlib.util.find_spec(module), f"{block}: {module}"
                if isinstance(node, ast.ImportFrom) and block.page != "docs/extending.md":
                    imported = importlib.import_module(module)
                    assert not [alias.name for alias in node.names if not hasattr(imported, alias.name)], str(block)


def _runs_on_the_folder(block: Block) -> bool:
    # What shows the public interface as a whole is run in tests/contracts/test_public_api.py.
    return ('"mine' in block.text or "dataset.read_events" in block.text) and "ctlev.read_events" not in block.text


def test_what_reads_an_exported_folder_runs(tmp_path, monkeypatch):
    """In order and with shared names, on a small folder and a small store; what needs a package that is missing not."""
    monkeypatch.chdir(tmp_path)
    _make_folder_and_store(tmp_path)
    names, run = {}, 0
    for block in (
        block for block in PYTHON_BLOCKS if block.page == "docs/quick_start.md" and _runs_on_the_folder(block)
    ):
        imported = re.findall(r"^(?:from|import) (\w+)", block.text, re.MULTILINE)
        if all(_is_installed(module) for module in imported):
            text = block.text.replace("/KEY", "/recorded").replace("num_workers=2", "num_workers=0")
            exec(compile(text, str(block), "exec"), names)
            run += 1
    assert run >= 4


def _is_installed(module: str) -> bool:
    """A folder of tests that is called as the package is no package."""
    found = importlib.util.find_spec(module)
    return found is not None and found.origin is not None


def _make_folder_and_store(place: Path) -> None:
    """`mine` with event streams, and recorded frames as an artefact called `recorded`."""
    home = place / ".ctlev"
    made = make_generated(home)
    _, columns = make_streams(made, home, "streams", a_file=1)
    streams = publish(home, "export_events", "streams", columns, tables.EVENT_STREAMS, {"generated": made.synthetic})
    artefacts = made.artefacts | {"event streams": streams}
    write_image_folder(artefacts, place / "mine", name="docs", notice="")
    make_recorded(home)
