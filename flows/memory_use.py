"""As many processes side by side as fit into this machine's memory."""

from __future__ import annotations

import itertools
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from ctlev_core.processes import memory_mib
from data_contracts.errors import DataError
from flows.stage_costs import StageCost, estimate_stages
from tasks.runners import is_elsewhere
from tasks.stage import PlannedStage
from tasks.workers import WORKERS, num_workers


def use_memory(rows: Sequence[PlannedStage], home: Path) -> None:
    """Set CTLEV_WORKERS where the largest stages of a plan do not fit into memory together, and say so.

    Raises:
        DataError: as `fitting_processes`.
    """
    if os.environ.get(WORKERS) or all(row.cached for row in rows):
        return
    wanted, fitting = num_workers(), fitting_processes(rows, estimate_stages(rows, home))
    if fitting < wanted:
        os.environ[WORKERS] = str(fitting)
        print(
            f"{fitting} of {wanted} processes: the largest stages do not fit into memory together, of which "
            f"{memory_mib()[1] / 1024:.1f} GiB are free",
            file=sys.stderr,
        )


def fitting_processes(rows: Sequence[PlannedStage], costs: Mapping[str, StageCost | None]) -> int:
    """How many stages may run side by side, one at least; what CTLEV_WORKERS says where it says anything.

    Where other machines compute, their memory is not known.

    Raises:
        DataError: one stage alone needs more memory than the machine has, and CTLEV_WORKERS does not say to try.
    """
    wanted = num_workers()
    stages = {row.key: row for row in rows if not row.cached}
    needs = {key: cost.memory_mib for key in stages if (cost := costs.get(key)) is not None}
    largest = sorted(needs, key=lambda key: needs[key], reverse=True)[:wanted]
    if os.environ.get(WORKERS) or is_elsewhere() or not largest:
        return wanted
    whole, free = memory_mib()
    if needs[largest[0]] > whole:
        raise DataError(
            f"{stages[largest[0]].label}: needs about {needs[largest[0]] / 1024:.1f} GiB of memory, this machine has "
            f"{whole / 1024:.1f}; generator.options.gradient_checkpointing=true and a smaller batch_size of generator "
            f"and sampling take less; {WORKERS}=1 tries all the same"
        )
    fitting = sum(total <= free for total in itertools.accumulate(needs[key] for key in largest))
    return wanted if fitting == len(largest) else max(fitting, 1)
