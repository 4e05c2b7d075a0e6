"""Which code each stage and plug-in runs, so that a changed helper does not leave stale results in a store.

Cache keys hold the VERSION of stages and plug-ins, not their code. `import_closures.json` holds a digest of every
module that one of them imports, directly or through others, as it was when their versions were last looked at.
Comments, docstrings and layout do not count. After a change of code:

    python tests/golden/import_closures.py                        what changed, and whose results that may concern
    python tests/golden/import_closures.py --record               versions were raised where results changed
    python tests/golden/import_closures.py --record --same-output "faster, digests compared"
                                                                  where versions stay, because results do
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
RECORD = Path(__file__).with_suffix(".json")
PACKAGES = ("ctlev_core", "data_contracts", "tasks")
KINDS = ("datasets", "formats", "motions", "encodings", "conditions", "generators", "downstream", "metrics")
RUNNING_ALONE = {
    "tasks.stage", "tasks.store", "tasks.file_locks", "tasks.workers", "tasks.runners", "tasks.prefect_runs",
    "tasks.gpus", "tasks.slurm", "tasks.bucket", "tasks.bucket_cache", "tasks.bucket_files", "ctlev_core.plugins",
    "ctlev_core.plugin_contracts", "ctlev_core.processes",
    "ctlev_core.provenance.raw_file_digests", "data_contracts.errors", "data_contracts.run_record",
    "data_contracts.remembered_files", "data_contracts.home_folder",
}  # fmt: skip
"""Modules that say where and when code runs, not what comes out; their own tests say that it does not."""
COMMAND = "python tests/golden/import_closures.py --record"


@dataclass(frozen=True)
class Code:
    """The code as it is.

    Attributes:
        modules: digest by module.
        versions: of stages (`stage encode`) and plug-ins (`metrics frechet`).
        closures: modules of each of these.
    """

    modules: dict[str, str]
    versions: dict[str, int]
    closures: dict[str, frozenset[str]]


@dataclass(frozen=True)
class Change:
    """What differs from the record: modules, and stages and plug-ins that run them under the recorded version."""

    modules: tuple[str, ...]
    unraised: tuple[str, ...]
    outdated: bool


def read_code(root: Path = ROOT) -> Code:
    """Parse the packages of a source tree; nothing is imported or run."""
    files = {
        ".".join(path.relative_to(root).with_suffix("").parts): path
        for package in PACKAGES
        for path in sorted((root / package).rglob("*.py"))
        if path.name != "__init__.py"
    }
    trees = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in files.items()}
    imports = {name: {to for to in _imports(tree) if to in trees} - RUNNING_ALONE for name, tree in trees.items()}
    units: dict[str, tuple[str, int]] = {}
    for name, tree in trees.items():
        package, _, stem = name.rpartition(".")
        if package.removeprefix("ctlev_core.") in KINDS and (version := _plugin_version(tree)) is not None:
            units[f"{package.removeprefix('ctlev_core.')} {stem}"] = name, version
        if package == "tasks":
            units |= {f"stage {stage}": (name, version) for stage, version in _stages(tree)}
    closures = {unit: _closure(module, imports) for unit, (module, _) in units.items()}
    wanted = sorted(set().union(*closures.values()))
    return Code(
        {name: digest(trees[name]) for name in wanted},
        {unit: version for unit, (_, version) in units.items()},
        closures,
    )


def compare(code: Code, record: Mapping[str, Any]) -> Change:
    """What of the code differs from the record."""
    changed = {name for name, found in code.modules.items() if record["modules"].get(name) != found}
    unraised = [
        unit
        for unit, version in code.versions.items()
        if unit in record["versions"] and version <= record["versions"][unit] and code.closures[unit] & changed
    ]
    outdated = changed or record["versions"] != code.versions or set(record["modules"]) != set(code.modules)
    return Change(tuple(sorted(changed)), tuple(sorted(unraised)), bool(outdated))


def explain(change: Change) -> str:
    """What is to be done about a change; empty where nothing is."""
    if not change.outdated:
        return ""
    if not change.unraised:
        return f"the record of import closures is not that of this code: {COMMAND}"
    return (
        f"changed: {', '.join(change.modules)}\n"
        f"runs in these, whose versions are the recorded ones: {', '.join(change.unraised)}\n"
        "Stored results of theirs stay valid. Where results change, raise a plug-in's VERSION, or a stage's version;\n"
        f"then: {COMMAND}\nWhere none changes: {COMMAND} --same-output 'how you know'"
    )


def digest(tree: ast.AST) -> str:
    """Of what a module does: its syntax tree without docstrings, positions and what Python versions add to it."""
    return hashlib.sha256(repr(_shape(tree)).encode()).hexdigest()[:16]


def _shape(node: Any) -> Any:
    if isinstance(node, list):
        return [_shape(item) for item in node]
    if not isinstance(node, ast.AST):
        return node
    fields = [(name, value) for name, value in ast.iter_fields(node) if value not in (None, [])]
    if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
        fields = [(name, _without_texts(value) if name == "body" else value) for name, value in fields]
    return (type(node).__name__, *((name, _shape(value)) for name, value in fields))


def _without_texts(body: list[ast.stmt]) -> list[ast.stmt]:
    """Statements but docstrings, of attributes too, which do nothing."""
    return [
        one
        for one in body
        if not (isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant) and isinstance(one.value.value, str))
    ]


def _imports(tree: ast.AST) -> Iterator[str]:
    """Modules that are imported anywhere in one, or loaded as a plug-in that is named there."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "plugins.load" and len(node.args) == 2:
            kind, name = (part.value if isinstance(part, ast.Constant) else None for part in node.args)
            if isinstance(kind, str) and isinstance(name, str):
                yield f"ctlev_core.{kind}.{name}"


def _closure(module: str, imports: Mapping[str, set[str]]) -> frozenset[str]:
    found, waiting = {module}, [module]
    while waiting:
        new = imports[waiting.pop()] - found
        found |= new
        waiting += new
    return frozenset(found)


def _plugin_version(tree: ast.Module) -> int | None:
    for node in tree.body:
        if isinstance(node, ast.Assign) and [ast.unparse(target) for target in node.targets] == ["VERSION"]:
            return ast.literal_eval(node.value)
    return None


def _stages(tree: ast.Module) -> Iterator[tuple[str, int]]:
    for node in tree.body:
        for decorator in getattr(node, "decorator_list", []):
            if not isinstance(decorator, ast.Call):
                continue
            given = {keyword.arg: keyword.value for keyword in decorator.keywords}
            # `@stage(...)`, or `@partial(_OwnStage, ...)`.
            if ast.unparse(decorator.func) in ("stage", "partial") and {"version", "schema"} <= given.keys():
                yield node.name, ast.literal_eval(given["version"])  # pyright: ignore[reportAttributeAccessIssue]


def main() -> int:
    """Exit status: 0 the record is that of the code, or was written; 1 something is to be done first."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--record", action="store_true", help="write the record anew")
    parser.add_argument("--same-output", metavar="WHY", default="", help="results are the same under old versions")
    arguments = parser.parse_args()
    code = read_code()
    record = json.loads(RECORD.read_text()) if RECORD.exists() else {"modules": {}, "versions": {}, "same_output": {}}
    change = compare(code, record)
    if not arguments.record or (change.unraised and not arguments.same_output):
        print(explain(change) or "the record is that of this code")
        return int(change.outdated)
    stated = {name: why for name, why in record["same_output"].items() if name in code.modules}
    if change.unraised:
        stated |= dict.fromkeys(change.modules, arguments.same_output)
    written = {"versions": code.versions, "modules": code.modules, "same_output": stated}
    RECORD.write_text(json.dumps(written, indent=1, sort_keys=True) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
