"""The notebook runs from top to bottom, as a reader runs it."""

import os
import sys
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[2] / "docs" / "tutorials" / "recording_to_samples.ipynb"


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_notebook_runs_and_shows_its_pictures(tmp_path, monkeypatch):
    nbformat, nbclient = (
        pytest.importorskip(name, reason=f"{name} is not installed: pip install -c constraints.txt -e '.[docs]'")
        for name in ("nbformat", "nbclient")
    )
    shown = nbformat.read(NOTEBOOK, 4)
    nbformat.validate(shown)
    made = nbformat.read(NOTEBOOK, 4)
    # `ctlev` is that of this environment, and of this checkout.
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", str(NOTEBOOK.parents[2]))
    nbclient.NotebookClient(
        made, timeout=1500, kernel_name="python3", resources={"metadata": {"path": tmp_path}}
    ).execute()

    def pictures(notebook):
        outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
        return ["image/png" in output.get("data", {}) for output in outputs if output.output_type == "execute_result"]

    assert pictures(made) == pictures(shown) == [False, True, True, True]
    assert (tmp_path / "notebook_home" / "reports" / "smoke.html").is_file()
    assert str(Path.home()) not in NOTEBOOK.read_text()
