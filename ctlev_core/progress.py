"""How far a loop is: reported to whoever watches, else drawn by tqdm where standard error is a terminal.

Loops make a `ProgressBar`, as they would one of tqdm. Where several stages run at the same time, in threads and in
processes, one process draws what all of them report: it puts a function that receives their reports in place with
`reporting_to`, and processes that work for it send theirs back (`tasks.workers`).
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

T = TypeVar("T")
REPORT_EVERY_S = 0.25


@dataclass(frozen=True)
class Progress:
    """How far a loop is.

    Attributes:
        what: name of the loop; empty for "the work has begun".
        done: so much of `total`, in `unit`.
        total: 0 where it is not known.
        unit: such as `step`.
        note: such as the loss.
    """

    what: str = ""
    done: int = 0
    total: int = 0
    unit: str = ""
    note: str = ""


Report = Callable[[Progress], None]
_report: ContextVar[Report | None] = ContextVar("ctlev_report", default=None)


def current_report() -> Report | None:
    """The function that receives reports here, if one does."""
    return _report.get()


@contextlib.contextmanager
def reporting_to(report: Report | None) -> Iterator[None]:
    """Inside this block loops report to a function, and draw nothing; with None they draw."""
    token = _report.set(report)
    try:
        yield
    finally:
        _report.reset(token)


class ProgressBar(Generic[T]):
    """The progress of one loop; takes the arguments of `tqdm.tqdm` that are used here, and has its methods.

    Args:
        iterable: whose items are counted as they are taken; without one, `update` counts.
        desc: name of the loop.
        total: its length; that of the iterable where it has one.
        initial: what was done before.
        unit: of what is counted.
        delay: seconds before it is drawn; loops within loops have one, and are not reported.
        disable: True = show nothing.
        unit_scale: as of tqdm.
    """

    def __init__(
        self,
        iterable: Iterable[T] = (),
        desc: str = "",
        total: int | None = None,
        *,
        initial: int = 0,
        unit: str = "it",
        delay: float = 0,
        disable: bool | None = None,
        unit_scale: bool = False,
    ) -> None:
        self._iterable, self._report = iterable, current_report()
        self._bar: Any = None
        if self._report is None:
            from tqdm import tqdm

            self._bar = tqdm(
                desc=desc,
                total=total if total is not None else _length(iterable),
                initial=initial,
                unit=unit,
                delay=delay,
                unit_scale=unit_scale,
                leave=False,
                disable=disable,
            )
        if disable or delay:
            self._report = None
        self._what, self._total, self._unit = desc, total or _length(iterable) or 0, unit
        self._done, self._note, self._reported = initial, "", 0.0
        self._tell(at_once=True)

    def __enter__(self) -> ProgressBar[T]:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[T]:
        with self:
            for item in self._iterable:
                yield item
                self.update()

    def update(self, count: int = 1) -> None:
        """So much more is done."""
        self._done += count
        if self._bar is not None:
            self._bar.update(count)
        self._tell(at_once=self._done == self._total)

    def note(self, text: str) -> None:
        """Say something beside the numbers, from the next update on."""
        self._note = text
        if self._bar is not None:
            self._bar.set_postfix_str(text, refresh=False)

    def close(self) -> None:
        """The loop is over."""
        if self._bar is not None:
            self._bar.close()

    def _tell(self, *, at_once: bool = False) -> None:
        if self._report is not None and (at_once or time.perf_counter() - self._reported >= REPORT_EVERY_S):
            self._reported = time.perf_counter()
            self._report(Progress(self._what, self._done, self._total, self._unit, self._note))


def _length(iterable: Iterable[Any]) -> int | None:
    return len(iterable) if hasattr(iterable, "__len__") and iterable else None  # pyright: ignore[reportArgumentType]
