"""Several experiments on one command and one page, run as a user would."""

import shutil

from flow_scripts import digests, run_script

STUDY = """
name: pair
data_notice: far too small to learn from
experiments:
  all: {extends: smoke}
  part: {extends: smoke, name: part, settings: [real], baselines: {}, scaling: [], set: [keep_faithful=null]}
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
    # The smaller one's frames, models and scores are the larger one's; only its pages are put together anew.
    assert new == ["contact_sheet", "realism", "report", "study_report"]
    page = (home / "reports" / "pair.html").read_text()
    for expected in ("2D pose (<code>all</code>)", "2D pose (<code>part</code>)", 'href="pair/part/report.html"'):
        assert expected in page
    assert (home / "reports" / "pair" / "all" / "report.html").exists()
