"""The presets as a table: of columns on a terminal, a plain line each elsewhere."""

from __future__ import annotations

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.preset_list import PRESETS, preset_heads

_FOLDERS = {
    "": "ctlev run NAME",
    "pretraining": "ctlev pretrain NAME",
    "speed_vs_error": "ctlev speed-vs-error NAME (options: ctlev options speed_vs_error/NAME)",
}


def print_presets() -> None:
    """Print every bundled preset: its name, how long it takes and what it does, by the command that takes it."""
    console = Console(highlight=False)
    for folder, command in _FOLDERS.items():
        heads = preset_heads(PRESETS / folder)
        console.print(f"[bold]{command}[/bold]")
        if console.is_terminal:
            table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 2, 0, 0))
            # A name is to be typed again, so that a narrow terminal folds the others and shortens none of these.
            table.add_column(min_width=2 + max(len(head.name) for head in heads))
            for head in heads:
                table.add_row(f"  [cyan]{head.name}[/cyan]", escape(head.summary), escape(head.time))
            console.print(table)
        else:
            width = max(len(head.name) for head in heads)
            for head in heads:
                told = head.summary + (f" ({head.time})" if head.time else "")
                console.print(f"  {head.name:{width}}  {told}", soft_wrap=True, markup=False)
        console.print()
    console.print(
        "ctlev options NAME lists what can be set; ctlev plan NAME what `ctlev run NAME` does and takes.",
        soft_wrap=True,
    )
