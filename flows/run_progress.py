"""What a run tells while it runs: on a terminal a line for all of it and one for each running stage, elsewhere a plain
line as each stage ends. Both on standard error, so that standard output holds the answer.

Stages run in threads and in processes; all report to one `RunProgress`, which alone draws.
"""

from __future__ import annotations

import contextlib
import math
import os
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

from rich.console import Console, ConsoleOptions, RenderResult
from rich.live import Live
from rich.markup import escape
from rich.progress_bar import ProgressBar as Bar
from rich.table import Table

from ctlev_core.duration_text import duration_text
from ctlev_core.progress import Progress, reporting_to
from flows.stage_costs import StageCost, estimate_stages, time_left
from tasks.stage import PlannedStage, watched_by
from tasks.workers import num_workers

REFRESH_PER_S = 4
ENOUGH_ENDED = 3
"""After so many stages the time left is corrected by how the others' times compare with what was expected."""


@dataclass
class _Running:
    """A stage that has begun: when, and how far its loop is."""

    started: float
    progress: Progress = field(default_factory=Progress)
    first: tuple[float, int] = (0.0, 0)

    def note(self, progress: Progress, now: float) -> None:
        if progress.what != self.progress.what:
            self.first = now, progress.done
        self.progress = progress

    def rate(self, now: float) -> float | None:
        """Units a second of the loop, since it was first heard of."""
        since, done = self.first
        return (self.progress.done - done) / (now - since) if now > since and self.progress.done > done else None


class RunProgress:
    """Watches the stages of one run.

    Args:
        rows: of the plan; a stage that is listed twice is one.
        costs: what stages are expected to take.
        workers: processes that run them side by side.
        stream: where to write.
    """

    def __init__(
        self,
        rows: Sequence[PlannedStage],
        costs: Mapping[str, StageCost | None],
        *,
        workers: int = 1,
        stream: TextIO | None = None,
    ) -> None:
        self.rows = {row.key: row for row in rows}
        self.costs = costs
        self._workers = workers
        self._console = Console(file=stream or sys.stderr, highlight=False)
        self._ended = {row.key for row in self.rows.values() if row.cached}
        self._computed: list[tuple[float, float | None]] = []
        self._running: dict[str, _Running] = {}
        self._lock = threading.Lock()
        self._started = time.monotonic()

    def progressed(self, key: str, progress: Progress) -> None:
        """A stage has begun, or its loop is so far."""
        now = time.monotonic()
        with self._lock:
            self._running.setdefault(key, _Running(now)).note(progress, now)

    def ended(self, key: str, rows: int, *, cached: bool) -> None:
        """A stage has made its table of so many rows, or found it."""
        now = time.monotonic()
        with self._lock:
            running = self._running.pop(key, None)
            if key in self._ended:
                return
            self._ended.add(key)
            cost = self.costs.get(key)
            if running is not None and not cached:
                self._computed.append((now - running.started, None if cost is None else cost.seconds))
            # Of a stage on a cluster nobody hears when it began.
            took = "cached" if cached else "" if running is None else f"{now - running.started:.1f} s"
            line = self._line(key, rows, took)
        if not self.is_drawn:
            self._console.print(line, markup=False, soft_wrap=True)

    def _line(self, key: str, rows: int, took: str) -> str:
        count = f"[{len(self._ended):{len(str(len(self.rows)))}}/{len(self.rows)}]"
        label = self.rows[key].label if key in self.rows else key
        left = self.seconds_left() if len(self._ended) < len(self.rows) else None
        told = [f"{count} {label}", f"{rows:,} rows", took, "" if left is None else f"about {duration_text(left)} left"]
        return "  ".join(filter(None, told))

    def seconds_left(self) -> float | None:
        """Until the end, by what stages of this run and of earlier ones took; None where nothing is known."""
        if not any(self.costs.get(key) for key in self.rows if not self.rows[key].cached):
            return None
        now = time.monotonic()
        done = {key: now - running.started for key, running in self._running.items()}
        done |= dict.fromkeys(self._ended, math.inf)
        left = time_left(self.rows.values(), self.costs, done, self._workers)
        compared = [(took, expected) for took, expected in self._computed if expected]
        if len(compared) >= ENOUGH_ENDED:
            slower = sum(took for took, _ in compared) / max(sum(expected for _, expected in compared), 1e-9)
            left *= min(max(slower, 0.25), 4.0)  # of short stages the first import what the others find imported
        return left

    def begin(self) -> None:
        """Say what is to be done."""
        if self.is_drawn:
            return
        cached, left = len(self._ended), self.seconds_left()
        told = f"{len(self.rows)} stages" + (f", {cached} of them cached" if cached else "")
        self._console.print(
            told + ("" if left is None else f"; about {duration_text(left)}"), markup=False, soft_wrap=True
        )

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """All lines, as they are now."""
        now = time.monotonic()
        with self._lock:
            ended, running, left = len(self._ended), list(self._running.items()), self.seconds_left()
        table = Table.grid(padding=(0, 2, 0, 0))
        for _ in range(5):
            table.add_column(no_wrap=True, overflow="ellipsis")
        left_text = "" if left is None else f"about {duration_text(left)} left"
        whole = f"stage {min(ended + 1, len(self.rows))} of {len(self.rows)}"
        table.add_row(
            f"[bold]{whole}[/bold]", Bar(len(self.rows), ended, width=20), duration_text(now - self._started), left_text
        )
        for key, stage in running[: max(console.height - 3, 1)]:
            table.add_row(*self._cells(key, stage, now))
        yield table

    def _cells(self, key: str, stage: _Running, now: float) -> list[str | Bar]:
        at, rate = stage.progress, stage.rate(now)
        count = f"{at.done:,}{f' of {at.total:,}' if at.total else ''} {at.unit}s" if at.unit else ""
        label = self.rows[key].label if key in self.rows else at.what
        speed = "" if rate is None else f"{rate:.3g}/s"
        bar = Bar(at.total, at.done, width=20) if at.total else ""
        return [
            f"  {escape(label)}",
            bar,
            duration_text(now - stage.started),
            f"{count} {speed}".strip(),
            escape(at.note),
        ]

    @property
    def is_drawn(self) -> bool:
        """Is it written to a terminal?"""
        return self._console.is_terminal

    def drawn(self) -> Live:
        """A block in which it is drawn, again and again; nothing of it stays."""
        return Live(self, console=self._console, refresh_per_second=REFRESH_PER_S, transient=True)

    def other(self, progress: Progress) -> None:
        """A loop outside of stages, such as an export, is so far."""
        if progress.total and progress.done >= progress.total:
            with self._lock:
                self._running.pop(progress.what, None)
        else:
            self.progressed(progress.what, progress)


@contextlib.contextmanager
def shown(rows: Sequence[PlannedStage], home: Path) -> Iterator[RunProgress]:
    """Inside this block the stages of a plan are watched and drawn."""
    progress = RunProgress(rows, estimate_stages(rows, home), workers=num_workers())
    progress.begin()
    with watched_by(progress), reporting_to(progress.other):
        if not progress.is_drawn:
            yield progress
            return
        # Bars of other packages, in the processes that run stages, would be drawn across ours.
        os.environ.setdefault("TQDM_DISABLE", "1")
        with progress.drawn():
            yield progress
