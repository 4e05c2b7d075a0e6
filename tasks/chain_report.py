"""The page on where a generator loses realism, and its table."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ctlev_core.events.windows import spread
from ctlev_core.report.page.html import render_report
from ctlev_core.report.page.report_files import PAGE, publish_page
from ctlev_core.report.studies.realism_chain import GRID_COLUMNS, ChainPage
from data_contracts import tables
from data_contracts.manifest import Manifest, ManifestRef, matching_rows
from data_contracts.realism_chain import Link
from data_contracts.training_sets import RECORDED
from tasks.stage import Output, stage

TABLE = f"{tables.REALISM_CHAIN.name}.parquet"


@stage(version=2, schema=tables.REPORT)
def chain_report(
    out: Output,
    frames: Manifest,
    measured: Manifest,
    processed: list[Manifest],
    *,
    links: list[Link],
    title: str,
    notice: str,
) -> pa.Table:
    """Write `report.html` and the table of all measurements.

    Args:
        out: of the stage.
        frames: recorded ones.
        measured: the table `realism_chain`.
        processed: what frames became, one artefact a link.
        links: the parts.
        title: what the experiment is called.
        notice: what data these are.
    """
    rows = matching_rows(frames, processed[0])
    shown = spread(len(rows), GRID_COLUMNS)
    pictures = {(RECORDED, 0): np.asarray(frames.array("frames")[rows[shown]])}
    for link, made in zip(links, processed, strict=True):
        pictures[link.kind, link.amount] = np.asarray(made.array("frames")[shown])
    page = ChainPage(measured.table.to_pylist(), pictures)
    html = render_report(
        title=f"{title}: where realism is lost", lead=notice, verdict=page.verdict(), sections=page.sections()
    )
    (out.folder / PAGE).write_text(html, encoding="utf-8")
    pq.write_table(measured.table, out.folder / TABLE)
    return pa.table({"table": [tables.REALISM_CHAIN.name], "file": [TABLE]})


def publish_chain_report(ref: ManifestRef, home: Path, name: str) -> str:
    """Put the newest page of an experiment, and its table, where a person looks for them; says where the page is."""
    return f"where realism is lost: {publish_page(ref, TABLE, home, f'{name}_realism_chain')}"
