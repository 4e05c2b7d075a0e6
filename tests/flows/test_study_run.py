"""Several experiments on one command and one page, run as a user would."""

import shutil

import pyarrow.parquet as pq
import pytest
from browser import CHROMIUM, check_pages
from flow_scripts import digests, run_script

STUDY = """
name: pair
data_notice: far too small to learn from
experiments:
  all: {extends: smoke}
  part: {extends: smoke, name: part, training_sets: [recorded], baselines: {}, scaling: [], set: [keep_fraction=null]}
speed_vs_error:
  experiment: all
  num_images: 4
  seeds: [0]
  reference: {options: {scheduler: ddpm}, steps: [4]}
  converged: {options: {scheduler: unipc}, steps: [5]}
  lines: {UniPC: {options: {scheduler: unipc}, steps: [2]}}
"""


@pytest.fixture(scope="module")
def study(smoke_home, tmp_path_factory):
    """The home of a finished study, and the digests that its experiments had made before it."""
    folder = tmp_path_factory.mktemp("study")
    home = shutil.copytree(smoke_home, folder / "home")
    (folder / "pair.yaml").write_text(STUDY)
    before = digests(home)
    finished = run_script("full_experiment", "--preset", str(folder / "pair.yaml"), home=home)
    assert finished.status == 0, finished.errors
    return home, before


@pytest.mark.slow
def test_a_study_runs_what_its_experiments_have_not_run_yet(study):
    home, before = study
    made = digests(home)
    assert before.items() <= made.items()
    new = sorted(name.partition("/")[0] for name in made.keys() - before.keys())
    # The smaller one's frames, models and scores are the larger one's; only its pages are put together anew. And the
    # generator whose solvers are compared is the larger one's.
    pages = ["contact_sheet", "report", "study_report"]
    assert new == sorted([*pages, *["sample_timed"] * 3, "sampling_errors", "speed_report"])
    page = (home / "reports" / "pair.html").read_text()
    for expected in ("2D pose (all)", "2D pose (part)", 'href="pair/part/report.html"'):
        assert expected in page
    assert (home / "reports" / "pair" / "all" / "report.html").exists()
    assert "Speed against error: 2D pose (all)" in page
    speed = home / "reports" / "pair" / "speed_vs_error"
    assert "all: speed against error of sampling" in (speed / "report.html").read_text()
    lines = pq.read_table(speed / "speed_vs_error.parquet")["line"].to_pylist()
    assert set(lines) == {"reference", "converged", "UniPC"}


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
def test_every_page_can_be_read_at_every_width(study, tmp_path):
    home, _ = study
    assert run_script("compare", "smoke", "pair/part", home=home).status == 0
    reports = home / "reports"
    pages = sorted(str(path.relative_to(reports)) for path in reports.rglob("*.html"))
    assert len(pages) >= 6
    check_pages(reports, pages, tmp_path)
