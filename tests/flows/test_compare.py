"""Two finished runs compared from the command line."""

import subprocess
import sys

from flow_scripts import REPOSITORY


def compare(home, *runs):
    command = [sys.executable, str(REPOSITORY / "flows" / "compare.py"), *runs, "--home", str(home)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


def test_a_run_is_compared_with_itself_by_name_and_by_key(smoke_home):
    published = (smoke_home / "reports" / "smoke" / "provenance.json").read_bytes()
    kept = (smoke_home / "artefacts" / "report").iterdir()
    artefact = next(path for path in kept if (path / "provenance.json").read_bytes() == published)
    finished = compare(smoke_home, "smoke", artefact.name[:10])
    assert finished.returncode == 0, finished.stderr
    assert "Differences: 0 in options, 0 in data, 0 in code." in finished.stdout
    page = smoke_home / "reports" / f"compare_smoke_{artefact.name[:12]}.html"
    assert f"comparison: {page}" in finished.stdout and "Scores</h2>" in page.read_text()
    page.unlink()  # other tests expect one report


def test_an_unknown_run_is_named_with_those_there_are(smoke_home):
    finished = compare(smoke_home, "smoke", "absent")
    assert finished.returncode == 2 and "Traceback" not in finished.stderr
    assert "run 'absent'" in finished.stderr and "which has reports smoke and keys" in finished.stderr
