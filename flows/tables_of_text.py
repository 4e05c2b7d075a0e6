"""Tables for people: columns that wrap on a terminal, aligned plain lines elsewhere."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

MAX_ALIGNED = 36
"""A longer entry of a plain line pushes what follows, so that one does not widen all."""


def print_table(
    title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], *, right: Sequence[int] = ()
) -> None:
    """Print a table on standard output.

    Args:
        title: above it.
        columns: their names.
        rows: texts; the last column is the one that may be long.
        right: numbers of the columns that hold numbers.
    """
    console = Console(highlight=False)
    console.print(f"[bold]{escape(title)}[/bold]", soft_wrap=True)
    if not rows:
        console.print("  (none)\n")
        return
    if not console.is_terminal:
        widths = [min(max(len(row[column]) for row in [columns, *rows]), MAX_ALIGNED) for column in range(len(columns))]
        for row in [columns, *rows]:
            cells = [
                f"{cell:>{width}}" if number in right else f"{cell:{width}}"
                for number, (cell, width) in enumerate(zip(row, widths, strict=True))
            ]
            print("  " + "  ".join(cells).rstrip())
        print()
        return
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for number, column in enumerate(columns):
        table.add_column(column, justify="right" if number in right else "left", overflow="fold")
    for row in rows:
        table.add_row(f"[cyan]{escape(row[0])}[/cyan]", *map(escape, row[1:]))
    console.print(table)
