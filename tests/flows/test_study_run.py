"""Several experiments on one command and one page, run as a user would."""

import shutil

import pyarrow.parquet as pq
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


def test_a_study_runs_what_its_experiments_have_not_run_yet(smoke_home, tmp_path):
    home = shutil.copytree(smoke_home, tmp_path / "home")
    (tmp_path / "pair.yaml").write_text(STUDY)
    before = digests(home)
    finished = run_script("full_experiment", "--preset", str(tmp_path / "pair.yaml"), home=home)
    assert finished.status == 0, finished.errors
    made = digests(home)
    assert before.items() <= made.items()
    new = sorted(name.partition("/")[0] for name in made.keys() - before.keys())
    # The smaller one's frames, models and scores are the larger one's; only its pages are put together anew. And the
    # generator whose solvers are compared is the larger one's.
    pages = ["contact_sheet", "realism", "report", "study_report"]
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
