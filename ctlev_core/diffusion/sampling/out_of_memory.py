"""Go on with smaller batches where memory runs out."""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable, Iterator
from typing import TypeVar

import torch

logger = logging.getLogger(__name__)

R = TypeVar("R")

_MESSAGES = ("out of memory", "can't allocate memory", "CUBLAS_STATUS_ALLOC_FAILED")


def is_out_of_memory(error: BaseException) -> bool:
    """Did memory run out, on whichever device? Libraries raise plain errors of many names for it."""
    if isinstance(error, (MemoryError, torch.OutOfMemoryError)):
        return True
    return isinstance(error, RuntimeError) and any(message.lower() in str(error).lower() for message in _MESSAGES)


class ShrinkingBatches:
    """Batches of a size that is halved, for good, each time that memory runs out.

    Args:
        size: images a batch, at first.
    """

    def __init__(self, size: int) -> None:
        self.size = size

    def map(self, work: Callable[[slice], R], count: int) -> Iterator[tuple[slice, R]]:
        """`work` of consecutive slices of `count` rows; a slice for which memory ran out is cut in two and done again.

        Raises:
            What `work` raises; running out of memory with a single row, too.
        """
        start = 0
        while start < count:
            rows = slice(start, min(start + self.size, count))
            try:
                result = work(rows)
            except (MemoryError, RuntimeError) as error:
                self._shrink(rows.stop - rows.start, error)
            else:
                yield rows, result
                start = rows.stop
                continue
            # Only here, where the error and with it the frames it kept alive are gone, can memory be given back.
            gc.collect()
            if torch.cuda.is_available():
                torch.cuda.empty_cache()

    def _shrink(self, count: int, error: Exception) -> None:
        """Halve after a batch of `count`, or raise the error where that does not help."""
        if not is_out_of_memory(error):
            raise error
        if count == 1:
            error.add_note("one image does not fit into memory; fewer pixels or a lower precision may")
            raise error
        self.size = count // 2
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        logger.warning("memory ran out with %d images a batch; going on with %d (%s)", count, self.size, reason)
