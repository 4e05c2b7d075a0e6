"""Tables of the report as one structure, written as Markdown and as LaTeX; `templates` has them for browsers.

Cells are texts or numbers. Columns of numbers are formatted alike and aligned to the right in every language, and an
uncertainty behind a number (`6.31 ± 0.02`, `6.31 [6.12, 6.50]`) is set smaller where the language can.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TypeGuard

import numpy as np

Cell = str | float | int | bool | None
NO_VALUE = "–"
# A number, then perhaps its uncertainty: "6.31", "-1,234", "5.0e-3", "6.31 ± 0.02", "6.313 [6.120, 6.500]", "93 %".
_NUMBER = re.compile(r"^([-+−]?[\d,]*\.?\d+(?:e[-+]?\d+)?)((?:\s*%)?)(\s*(?:±|\[|\().*)?$", re.IGNORECASE)
_LATEX = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#", "%": r"\%", "_": r"\_",
    "^": r"\textasciicircum{}", "~": r"\textasciitilde{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "|": r"\textbar{}", '"': r"\textquotedbl{}", "[": "{[}", "]": "{]}",
    "↑": r"$\uparrow$", "↓": r"$\downarrow$", "±": r"$\pm$", "−": "$-$", "–": "--", "∞": r"$\infty$", "×": r"$\times$",
    "≤": r"$\leq$", "≥": r"$\geq$", "µ": r"$\mu$", "·": r"$\cdot$", "→": r"$\rightarrow$",
}  # fmt: skip
_MARKDOWN = re.compile(r"([\\`*_\[\]<>|#~])")


@dataclass(frozen=True)
class Table:
    """A table the reader can sort by clicking a heading.

    Attributes:
        title: heading of the section.
        columns: column headings.
        rows: cells; numbers are formatted column by column, texts are shown as they are, None and NaN as a dash.
        caption: what the reader must know to read it.
        footnotes: one line each, below.
        bold: (row, column) of cells to emphasise.
        folded: closed until the reader opens it.
        anchor: what links in the page lead to it by; empty = none do.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""
    footnotes: Sequence[str] = ()
    bold: Collection[tuple[int, int]] = ()
    folded: bool = False
    anchor: str = ""


@dataclass(frozen=True)
class Formatted:
    """The texts of a table, row by row, and which columns hold numbers only."""

    rows: list[list[str]]
    numeric: list[bool]


def format_table(table: Table) -> Formatted:
    """Texts of all cells.

    Raises:
        ValueError: a row has another number of cells than there are columns.
    """
    for number, row in enumerate(table.rows):
        if len(row) != len(table.columns):
            raise ValueError(
                f"table {table.title!r}: row {number} has {len(row)} cells for {len(table.columns)} columns"
            )
    columns = [format_column([row[index] for row in table.rows]) for index in range(len(table.columns))]
    numeric = [all(split_number(text) for text in column if text != NO_VALUE) for column in columns]
    return Formatted([list(row) for row in zip(*columns, strict=True)], numeric)


@dataclass(frozen=True)
class ShownCell:
    """A cell as a page shows it: the text, or number, unit and uncertainty apart, and a key to sort numbers by."""

    text: str
    uncertainty: str = ""
    sort_key: str = ""
    numeric: bool = False
    bold: bool = False


def shown_cells(table: Table) -> tuple[list[bool], list[list[ShownCell]]]:
    """Which columns hold numbers only, and all cells row by row.

    Raises:
        ValueError: as `format_table`.
    """
    shown = format_table(table)
    rows = []
    for y, row in enumerate(shown.rows):
        cells = []
        for x, text in enumerate(row):
            numeric, bold = shown.numeric[x], (y, x) in table.bold
            found = split_number(text) if numeric else None
            if found is None:
                cells.append(ShownCell(text, numeric=numeric, bold=bold))
            else:
                number, unit, uncertainty = found
                sort_key = number.replace(",", "").replace("−", "-")
                cells.append(ShownCell(number + unit, uncertainty, sort_key, numeric, bold))
        rows.append(cells)
    return shown.numeric, rows


def split_number(text: str) -> tuple[str, str, str] | None:
    """Number, unit and uncertainty of a cell's text; None where it does not begin with a number."""
    match = _NUMBER.match(text)
    return (match.group(1), match.group(2), match.group(3) or "") if match else None


def format_column(cells: Sequence[Cell]) -> list[str]:
    """Texts of the cells of one column; fractions get the same number of decimals, enough for 4 significant digits."""
    decimals = 0
    for cell in cells:
        if _is_fraction(cell) and math.isfinite(cell):
            shortest = f"{float(cell):.4g}"
            decimals = max(decimals, len(shortest.partition(".")[2]) if "e" not in shortest else 0)
    return [_format(cell, decimals) for cell in cells]


def _is_fraction(cell: object) -> TypeGuard[float]:
    return isinstance(cell, float | np.floating)


def _format(cell: Cell, decimals: int) -> str:
    if cell is None or (_is_fraction(cell) and math.isnan(cell)):
        return NO_VALUE
    if isinstance(cell, str):
        return cell or NO_VALUE  # as it is: a name keeps the code behind it
    if isinstance(cell, bool | np.bool_):
        return "yes" if cell else "no"
    if isinstance(cell, int | np.integer):
        return f"{int(cell):,}"
    if not _is_fraction(cell):
        return str(cell)
    if math.isinf(cell):
        return "∞" if cell > 0 else "−∞"
    if cell and not 1e-4 <= abs(cell) < 1e9:
        return f"{float(cell):.3e}"
    return f"{float(cell):,.{decimals}f}"


def render_markdown(tables: Sequence[Table], *, title: str, lead: str = "", verdict: str = "") -> str:
    """A Markdown document of pipe tables, padded so that it is as legible in a terminal.

    Args:
        tables: in reading order.
        title: heading of the document.
        lead: what data this is about, one paragraph: what follows is the answer, and is found by that.
        verdict: the answer.
    Raises:
        ValueError: rows of a table do not fit its columns.
    """
    notice = " ".join(lead.split()) or "The experiment says nothing of its data."
    parts = [f"# {_markdown_text(title)}", _markdown_text(notice), _markdown_text(verdict)]
    for table in tables:
        notes = "\n".join(f"- {_markdown_text(note)}" for note in table.footnotes)
        parts += [f"## {_markdown_text(table.title)}", _markdown_text(table.caption), markdown_table(table), notes]
    return "\n\n".join(part for part in parts if part) + "\n"


def markdown_table(table: Table, *, plain: bool = False) -> str:
    """The pipe table alone; plain for terminals: nothing is escaped, and a star stands behind what is bold."""
    shown = format_table(table)
    if not shown.rows:
        return "No rows."
    head = list(table.columns) if plain else [_markdown_text(name) for name in table.columns]
    body = [
        [f"{text}*" if (y, x) in table.bold else text for x, text in enumerate(row)]
        if plain
        else [
            f"**{_markdown_text(text)}**" if (y, x) in table.bold else _markdown_text(text)
            for x, text in enumerate(row)
        ]
        for y, row in enumerate(shown.rows)
    ]
    widths = [max(3, *(len(row[x]) for row in [head, *body])) for x in range(len(head))]
    rule = ["-" * (width - 1) + (":" if shown.numeric[x] else "-") for x, width in enumerate(widths)]
    padded = [
        [text.rjust(widths[x]) if shown.numeric[x] else text.ljust(widths[x]) for x, text in enumerate(row)]
        for row in [head, *body]
    ]
    return "\n".join("| " + " | ".join(row) + " |" for row in [padded[0], rule, *padded[1:]])


def _markdown_text(text: str) -> str:
    """Text with every sign escaped that Markdown would read; `code` stays code."""
    parts = re.split(r"(`[^`\n]+`)", " ".join(text.split()) if "\n\n" not in text else text)
    return "".join(
        part.replace("|", r"\|") if index % 2 else _MARKDOWN.sub(r"\\\1", part) for index, part in enumerate(parts)
    )


def render_latex(tables: Sequence[Table], *, title: str, lead: str = "") -> str:
    """LaTeX `table` environments in the style of the package booktabs, to be read with the command `input`.

    Args:
        tables: in reading order; those without rows are left out.
        title: of the experiment; begins every label (`tab:TITLE-1`).
        lead: what data this is about; a comment at the top, and part of the first caption.
    Raises:
        ValueError: rows of a table do not fit its columns.
    """
    head = [f"% {title}: tables of the report.", "% \\usepackage[T1]{fontenc} \\usepackage{booktabs,graphicx}"]
    head += [f"% {line}" for line in lead.splitlines() if line.strip()]
    label = re.sub(r"[^A-Za-z0-9-]+", "-", title).strip("-")
    filled = [table for table in tables if table.rows]
    parts = [
        latex_table(table, f"tab:{label}-{number}", lead if number == 1 else "")
        for number, table in enumerate(filled, 1)
    ]
    return "\n".join(head) + "\n\n" + "\n\n".join(parts) + "\n"


def latex_table(table: Table, label: str, lead: str = "") -> str:
    """One `table` environment, never wider than the line."""
    shown = format_table(table)
    columns = "".join("r" if number else "l" for number in shown.numeric)
    body = [
        " & ".join(_latex_cell(text, shown.numeric[x], (y, x) in table.bold) for x, text in enumerate(row)) + r" \\"
        for y, row in enumerate(shown.rows)
    ]
    texts = [_latex_text(" ".join(text.split())) for text in (table.caption, *table.footnotes, lead) if text.strip()]
    sentences = [text if text.endswith((".", "?", "!")) else f"{text}." for text in [_latex_text(table.title), *texts]]
    caption = " ".join([rf"\textbf{{{sentences[0]}}}", *sentences[1:]])
    return "\n".join(
        [
            r"\begin{table}[t]",
            r"\centering",
            rf"\caption{{{caption}}}",
            rf"\label{{{label}}}",
            # Shrunk where it is wider than the line, and never enlarged.
            r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
            rf"\begin{{tabular}}{{{columns}}}",
            r"\toprule",
            " & ".join(_latex_text(name) for name in table.columns) + r" \\",
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}}",
            r"\end{table}",
        ]
    )


def _latex_cell(text: str, numeric: bool, bold: bool) -> str:
    number = split_number(text) if numeric else None
    if number is None:
        return rf"\textbf{{{_latex_text(text)}}}" if bold else _latex_text(text)
    value = _latex_text(number[0].replace("-", "−") + number[1])
    uncertainty = _latex_text(number[2].strip().replace("-", "−"))
    shown = rf"\textbf{{{value}}}" if bold else value
    return shown + (rf" {{\scriptsize {uncertainty}}}" if uncertainty else "")


def _latex_text(text: str) -> str:
    """Escaped text in which `this` is set as code."""
    parts = re.split(r"`([^`]+)`", text)
    escaped = ["".join(_LATEX.get(sign, sign) for sign in part) for part in parts]
    return "".join(rf"\texttt{{{part}}}" if index % 2 else part for index, part in enumerate(escaped))
