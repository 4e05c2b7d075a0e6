"""Numbers that stand in two places of the documentation are the same in both."""

from doc_pages import REPOSITORY

RESULTS = (REPOSITORY / "docs" / "results.md").read_text(encoding="utf-8")


def test_the_readme_has_the_scores_of_the_results_page():
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    table = text.split("| recorded | recorded + synthetic | paired difference |\n")[1].split("\n\n")[0]
    scores = [line.partition(" | ")[2] for line in table.splitlines()[1:]]
    assert len(scores) == 5
    assert not [row for row in scores if row not in RESULTS]
