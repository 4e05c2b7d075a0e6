"""A changed helper does not leave stale results: versions were raised, or somebody said that results are the same."""

import ast
import importlib
import json
from dataclasses import replace

import import_closures
import pytest

from ctlev_core import plugins
from tasks.stage import Stage

# What runners need that the extra `test` does not install.
EXTRAS = {"dask", "distributed", "dask_jobqueue", "ray"}


@pytest.fixture(scope="module")
def code():
    return import_closures.read_code()


def recorded():
    return json.loads(import_closures.RECORD.read_text())


def test_no_code_changed_without_a_word(code):
    change = import_closures.compare(code, recorded())
    assert not change.outdated, import_closures.explain(change)


def modules_of_tasks():
    """All modules of `tasks`, but runners whose extra is not installed."""
    for path in sorted((import_closures.ROOT / "tasks").glob("*.py")):
        try:
            yield importlib.import_module(f"tasks.{path.stem}")
        except ModuleNotFoundError as error:
            if error.name is None or error.name.partition(".")[0] not in EXTRAS:
                raise


def test_every_plugin_and_stage_is_known(code):
    found = {unit for kind in plugins.KINDS for unit in (f"{kind} {name}" for name in plugins.names(kind))}
    assert found == {unit for unit in code.versions if not unit.startswith("stage ")}
    stages = {value for module in modules_of_tasks() for value in vars(module).values() if isinstance(value, Stage)}
    assert {f"stage {stage.name}": stage.version for stage in stages} == {
        unit: version for unit, version in code.versions.items() if unit.startswith("stage ")
    }
    assert all(
        code.versions[f"{kind} {name}"] == v for kind in plugins.KINDS for name, v in plugins.versions(kind).items()
    )


def changed(code, module):
    return replace(code, modules=code.modules | {module: "0" * 16})


def test_a_changed_formula_concerns_its_metrics(code):
    change = import_closures.compare(changed(code, "ctlev_core.scoring.frechet"), recorded())
    assert {"metrics frechet", "metrics fd_infinity"} <= set(change.unraised)
    assert "metrics kid" not in change.unraised and "formats evt3" not in change.unraised
    text = import_closures.explain(change)
    assert "ctlev_core.scoring.frechet" in text and "raise a plug-in's VERSION" in text and "--same-output" in text


def test_a_raised_version_is_enough_but_is_recorded(code):
    new = changed(code, "ctlev_core.formats.evt3")
    raised = {
        unit: version + 1 for unit, version in new.versions.items() if "ctlev_core.formats.evt3" in new.closures[unit]
    }
    assert set(raised) == {"formats evt3"}
    change = import_closures.compare(replace(new, versions=new.versions | raised), recorded())
    assert change.unraised == () and change.outdated
    assert import_closures.explain(change).endswith("import_closures.py --record")


def test_what_says_nothing_changes_nothing():
    before = "def f(x):\n    '''Doc.'''\n    return x + 1  # one\n\nA = 3\n'''Of A.'''\n"
    after = '"""Module."""\nA_LIST: list = []\n'
    same = "def f(x):\n\n    return (x + 1)\nA = 3\n"
    digests = [import_closures.digest(ast.parse(text)) for text in (before, same, after, before.replace("1", "2"))]
    assert digests[0] == digests[1] and len(set(digests)) == 3


SOURCES = {
    "ctlev_core/metrics/fd.py": "from ctlev_core.scoring import formula\nVERSION = 1\n",
    "ctlev_core/scoring/formula.py": "def distance(a, b):\n    return abs(a - b)\n",
    "tasks/score.py": "@stage(version=3, schema=None)\ndef score(out):\n    from data_contracts import rows\n",
    "data_contracts/rows.py": "ROWS = 1\n",
}


def test_the_command_asks_for_a_word_and_keeps_it(tmp_path, monkeypatch, capsys):
    for name, text in SOURCES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    read, record = import_closures.read_code, tmp_path / "record.json"
    monkeypatch.setattr(import_closures, "read_code", lambda: read(tmp_path))
    monkeypatch.setattr(import_closures, "RECORD", record)

    def run(*arguments):
        monkeypatch.setattr("sys.argv", ["import_closures.py", *arguments])
        return import_closures.main(), capsys.readouterr().out

    assert run("--record")[0] == 0 and run()[0] == 0
    assert json.loads(record.read_text())["versions"] == {"metrics fd": 1, "stage score": 3}
    formula = tmp_path / "ctlev_core" / "scoring" / "formula.py"
    formula.write_text(formula.read_text().replace("abs(a - b)", "12345"))
    status, said = run()
    assert status == 1 and "metrics fd" in said and "stage score" not in said
    assert run("--record")[0] == 1
    assert run("--record", "--same-output", "a test")[0] == 0 and run()[0] == 0
    assert json.loads(record.read_text())["same_output"] == {"ctlev_core.scoring.formula": "a test"}
    formula.write_text(SOURCES["ctlev_core/scoring/formula.py"])
    metric = tmp_path / "ctlev_core" / "metrics" / "fd.py"
    metric.write_text(metric.read_text().replace("VERSION = 1", "VERSION = 2"))
    assert run()[0] == 1 and run("--record")[0] == 0 and run()[0] == 0
