"""One table in three languages."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctlev_core.report.page.tables import Table, latex_table, markdown_table, render_latex, render_markdown
from ctlev_core.report.studies.paper_numbers import TABLES

MIXED = Table(
    "Does it help? 95 %",
    ["trained on", "px ↓", "n_frames"],
    [["recorded", "6.870 [6.5, 7.2]", 1400], ["a_b & c|d", "-0.31 ± 0.02", None]],
    caption="With `code_x` & more",
    footnotes=["a note"],
    bold={(1, 1)},
)


def latex_cells(text: str) -> list[list[str]]:
    """Cells between the rules, split where a `&` is not escaped."""
    body = text.partition(r"\toprule")[2].partition(r"\bottomrule")[0]
    lines = [line.removesuffix(r" \\") for line in body.splitlines() if line.endswith(r" \\")]
    return [re.split(r" (?<!\\)& ", line) for line in lines]


def markdown_cells(text: str) -> list[list[str]]:
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]


def balanced(text: str) -> bool:
    depth = 0
    for brace in re.findall(r"(?<!\\)[{}]", text.replace(r"\\", "")):
        depth += 1 if brace == "{" else -1
        if depth < 0:
            return False
    return depth == 0


def test_latex_aligns_numbers_and_marks_bold_and_uncertainty():
    text = latex_table(MIXED, "tab:x-1")
    assert r"\begin{tabular}{lrr}" in text and balanced(text)
    assert latex_cells(text) == [
        ["trained on", r"px $\downarrow$", r"n\_frames"],
        ["recorded", r"6.870 {\scriptsize {[}6.5, 7.2{]}}", "1,400"],
        [r"a\_b \& c\textbar{}d", r"\textbf{$-$0.31} {\scriptsize $\pm$ 0.02}", "--"],
    ]
    assert r"\caption{\textbf{Does it help? 95 \%.} With \texttt{code\_x} \& more. a note.}" in text


def test_markdown_aligns_numbers_and_marks_bold():
    assert markdown_cells(markdown_table(MIXED)) == [
        ["trained on", "px ↓", r"n\_frames"],
        ["-" * 11, "-" * 17 + ":", "-" * 8 + ":"],
        ["recorded", r"6.870 \[6.5, 7.2\]", "1,400"],
        [r"a\_b & c\|d", "**-0.31 ± 0.02**", "–"],
    ]


def test_a_terminal_gets_texts_as_they_are_and_a_star_for_bold():
    text = markdown_table(MIXED, plain=True)
    assert "| a_b & c|d  |    -0.31 ± 0.02* |        – |" in text
    assert len({len(line) for line in text.splitlines()}) == 1


@given(st.text(st.characters(codec="ascii", exclude_categories=["C"]), min_size=1, max_size=30))
def test_any_text_stays_one_cell(text):
    table = Table("t", [text, "b"], [[text, "x"], ["y", text]])
    shown = markdown_cells(markdown_table(table))
    assert [len(row) for row in shown] == [2] * 4
    latex = latex_table(table, "tab:t")
    assert [len(row) for row in latex_cells(latex)] == [2] * 3 and balanced(latex)
    # What Markdown and LaTeX would read as more than text is escaped.
    bare = re.sub(r"`[^`]+`", "", text)
    if bare == text and "\\" not in text:
        assert re.sub(r"\\(.)", r"\1", shown[0][0]) == " ".join(text.split())
    assert not re.search(r"(?<!\\)[#%&_](?!\})", latex_cells(latex)[0][0].replace(r"\\", ""))


def test_documents_say_what_data_it_is_and_hold_every_table():
    markdown = render_markdown([MIXED, MIXED], title="demo", lead="Data: `studio`.", verdict="It helped.")
    assert markdown.startswith("# demo\n\nData: `studio`.\n\nIt helped.\n\n## Does it help?")
    latex = render_latex([MIXED, Table("empty", ["a"], []), MIXED], title="my demo_1", lead="Data: `studio`.")
    assert latex.startswith("% my demo_1: tables of the report.\n")
    assert re.findall(r"\\label\{(.*)\}", latex) == ["tab:my-demo-1-1", "tab:my-demo-1-2"]
    assert latex.count(r"Data: \texttt{studio}.") == 1
    assert latex.count(r"\begin{table}") == latex.count(r"\end{table}") == 2


def test_rows_that_do_not_fit_are_refused():
    for render in (markdown_table, lambda table: latex_table(table, "tab:t")):
        with pytest.raises(ValueError, match="row 1 has 1 cells for 2 columns"):
            render(Table("T", ["a", "b"], [[1, 2], [3]]))


def test_the_papers_numbers_are_those_of_its_source(paper_source):
    """Every number of each table, in order, and which of them are bold."""
    labels = ("compare_classfication", "compare_2d_skeleton", "compare_smpl_recovery", "FID_3Dsmpl")
    for label, table in zip((*labels, "zeroshot_classification"), TABLES, strict=True):
        before, _, _ = paper_source.partition(rf"\label{{tab:{label}}}")
        body = before.rpartition(r"\begin{tabular}")[2].partition(r"\end{tabular}")[0]
        cells = [line.split("&")[1:] for line in body.replace("\n", " ").split(r"\\")]
        found = [[cell for cell in row if re.search(r"\d\.\d|\$\s*-\s*\$", cell)] for row in cells]
        found = [row for row in found if row]
        numbers = [[(re.findall(r"\d+\.\d+", cell) or [None])[0] for cell in row] for row in found]
        assert numbers == [list(row[1:]) for row in table.rows]
        bold = {(y, x + 1) for y, row in enumerate(found) for x, cell in enumerate(row) if r"\textbf" in cell}
        assert bold == set(table.bold)


@pytest.fixture
def paper_source(pytestconfig) -> str:
    """The paper's LaTeX; it is not part of the repository."""
    path = pytestconfig.rootpath.parent / "shared" / "paper" / "controlevents.tex"
    if not path.is_file():
        pytest.skip("the paper's source is not beside this checkout")
    return path.read_text()
