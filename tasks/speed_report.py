"""The page on speed against error, and its table."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from ctlev_core.report.page.html import render_report
from ctlev_core.report.page.report_files import PAGE, publish_page
from ctlev_core.report.studies.speed_summary import SpeedSummary, write_speed_summary
from ctlev_core.report.studies.speed_vs_error import SpeedPage
from data_contracts import tables
from data_contracts.manifest import Manifest, ManifestRef
from data_contracts.speed_vs_error import SamplerSetting
from tasks.stage import Output, stage

TABLE = f"{tables.SPEED_VS_ERROR.name}.parquet"


@stage(version=4, schema=tables.REPORT)
def speed_report(
    out: Output,
    extractor: Manifest,
    conditions: Manifest,
    measured: list[Manifest],
    reference: Manifest,
    shown: list[Manifest],
    *,
    settings: list[SamplerSetting],
    own: SamplerSetting | None,
    title: str,
    notice: str,
    reference_name: str,
    converged_name: str,
    feature_extractor: str,
) -> pa.Table:
    """Write `report.html`, the table of all measurements, and `summary.json` for the page of a study.

    Args:
        out: of the stage.
        extractor: the model in whose features frames were compared.
        conditions: what was asked for.
        measured: the tables to show together.
        reference: timed samples of the reference.
        shown: timed samples of every setting, of the same seed.
        settings: of `shown`.
        own: the setting of `settings` that the experiment samples with, if it is among them.
        title: what the experiment is called.
        notice: what data these are.
        reference_name: sampler and steps of the reference.
        converged_name: and of what counts as converged.
        feature_extractor: name of the plug-in of `extractor`.
    """
    table = pa.concat_tables([manifest.table for manifest in measured])
    pictures = {
        (setting.line, setting.num_inference_steps): manifest.array("frames")
        for setting, manifest in zip(settings, shown, strict=True)
    }
    asked = None
    if conditions.has_array("images"):
        row_of = {name: row for row, name in enumerate(conditions.column("sample_id"))}
        asked = conditions.array("images")[[row_of[name] for name in reference.column("condition_id")]]
    page = SpeedPage(
        rows=table.to_pylist(),
        pictures=pictures,
        reference_pictures=reference.array("frames"),
        condition_pictures=asked,
        reference_name=reference_name,
        converged_name=converged_name,
        own=None if own is None else (own.line, own.num_inference_steps),
        features=f"{feature_extractor}, {extractor.ref.digest[:8]}",
    )
    html = render_report(
        title=f"{title}: speed against error of sampling",
        lead=notice,
        verdict=page.verdict(),
        sections=page.sections(),
    )
    (out.folder / PAGE).write_text(html, encoding="utf-8")
    pq.write_table(table, out.folder / TABLE)
    # Image by image a few samples tell solvers apart; distances of distributions seldom do.
    charts = [*page.solution_charts(), *page.distance_charts()[:1]]
    write_speed_summary(out.folder, SpeedSummary(title, page.recommendation(), charts, page.settings()))
    return pa.table({"table": [tables.SPEED_VS_ERROR.name], "file": [TABLE]})


def publish_speed_report(ref: ManifestRef, home: Path, name: str) -> str:
    """Put the newest page of an experiment, and its table, where a person looks for them; says where the page is."""
    return f"speed against error: {publish_page(ref, TABLE, home, name)}"
