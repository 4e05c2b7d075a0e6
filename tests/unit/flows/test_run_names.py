"""What runs are called on Prefect's pages."""

from flows.settings import run_named


def test_runs_are_named_by_what_they_are_part_of():
    with run_named("full-experiment", "demo") as study:
        with run_named("full-experiment", "demo_pose") as part:
            with run_named("synthesize", "demo_pose") as step:
                pass
            with run_named("evaluate", "demo_pose") as other:
                pass
        with run_named("full-experiment", "objects") as another:
            pass
    assert (study, part, another) == ("demo", "demo / pose", "demo / objects")
    assert (step, other) == ("demo / pose / synthesize", "demo / pose / evaluate")


def test_runs_of_their_own():
    with run_named("synthesize", "pose") as step:
        assert step == "pose / synthesize"
    with run_named("compare", "") as alone:
        assert alone == "compare"
