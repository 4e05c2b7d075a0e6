"""A stage as a task run of Prefect: its log, its pictures, and further attempts after errors that pass.

CTLEV_STAGE_RETRIES   attempts after the first, where a file or the network failed in a way that may pass; 2
CTLEV_SHOW_STAGES     1: show on Prefect's pages what a stage made, and its log; else 0, which saves a tenth of a
second a stage. The default is 1 on a server of the user's own (PREFECT_API_URL), where
somebody may look; a script's private server ends with the script
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable
from typing import Any

from data_contracts.errors import DataError
from data_contracts.manifest import ManifestRef, read_manifest
from tasks.runners import is_passing

RETRIES = "CTLEV_STAGE_RETRIES"
SHOW = "CTLEV_SHOW_STAGES"
DEFAULT_RETRIES = 2
BACKOFF_S = 2.0
"""Before the second attempt; twice as long before each further one."""


def run_as_task(name: str, label: str, work: Callable[[], tuple[ManifestRef, bool]]) -> ManifestRef:
    """Run through Prefect, so that the run, its state (Completed or Cached) and its time are recorded there.

    Args:
        name: of the stage.
        label: of this run of it.
        work: gives the artefact, and whether it was there already.
    """
    from prefect import task
    from prefect.cache_policies import NO_CACHE
    from prefect.logging import get_run_logger
    from prefect.states import Completed
    from prefect.tasks import exponential_backoff

    shown = os.environ.get(SHOW, "1" if os.environ.get("PREFECT_API_URL") else "0") != "0"

    # The store decides what is cached. Prefect's own cache would be a second, weaker opinion.
    @task(
        name=name,
        task_run_name=label.replace("{", "(").replace("}", ")"),
        cache_policy=NO_CACHE,
        persist_result=False,
        retries=num_retries(),
        retry_delay_seconds=exponential_backoff(backoff_factor=BACKOFF_S),
        retry_condition_fn=_may_pass,
    )
    def run() -> Any:
        started = time.monotonic()
        if shown:
            get_run_logger().info("%s begins", label)
        ref, cached = work()
        told = f"{ref.rows} rows" + (", as they were" if cached else f" in {time.monotonic() - started:.1f} s")
        if shown:
            get_run_logger().info("%s: %s, key %s", label, told, ref.key[:12])
            if not cached:
                _show(ref, label)
        return Completed(data=ref, name="Cached" if cached else "Completed", message=f"{told}, key {ref.key[:12]}")

    return run(return_state=True).result()


def num_retries() -> int:
    """The variable CTLEV_STAGE_RETRIES.

    Raises:
        DataError: it is no number up to 20, before which an attempt would wait for weeks.
    """
    asked = os.environ.get(RETRIES, "")
    if asked and not re.fullmatch(r"1?\d|20", asked, re.ASCII):
        raise DataError(f"{RETRIES} must be a number of further attempts, 0 to 20, got {asked!r}")
    return int(asked) if asked else DEFAULT_RETRIES


def _may_pass(task: Any, task_run: Any, state: Any) -> bool:
    """Would another attempt be of use?"""
    return is_passing(state.result(raise_on_failure=False))


def _show(ref: ManifestRef, label: str) -> None:
    """What was made as an artefact of the run: images, curves, scores, or where the report is."""
    from prefect.artifacts import create_markdown_artifact

    from ctlev_core.report.stage_page import stage_page

    key = re.sub(r"[^a-z0-9]+", "-", label.lower()).strip("-")
    create_markdown_artifact(stage_page(read_manifest(ref), label), key=key[:100], description=label)
