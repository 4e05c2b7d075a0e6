"""A page of conditions over event frames, to be looked at before anything is trained."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa

from ctlev_core.report.page.html import render_report
from ctlev_core.report.page.report_files import page_facts, publish_file
from ctlev_core.report.sections.contact_sheet import contact_sheet_sections
from data_contracts import tables
from data_contracts.manifest import Manifest, ManifestRef
from tasks.stage import Output, stage

PAGE = "contact_sheet.html"


@stage(version=2, schema=tables.REPORT)
def contact_sheet(
    out: Output, frames: Manifest, frame_conditions: Manifest, sample_conditions: Manifest, *, title: str, notice: str
) -> pa.Table:
    """Write `contact_sheet.html`: training frames with their conditions, and the conditions to sample from."""
    sections = contact_sheet_sections(frames, frame_conditions, sample_conditions)
    advice = "What the generator learns from and is asked for: to be looked at before anything is trained."
    page = render_report(title=f"{title}: conditions", lead=notice, verdict=advice, sections=sections)
    (out.folder / PAGE).write_text(page, encoding="utf-8")
    return pa.table({"table": ["contact_sheet"], "file": [PAGE]})


def publish_contact_sheet(ref: ManifestRef, home: Path, name: str) -> str:
    """Put the newest contact sheet of an experiment where a person looks for it, and say where that is."""
    path = home / "reports" / f"{name}_conditions.html"
    path.parent.mkdir(parents=True, exist_ok=True)
    publish_file(ref.path / PAGE, path, facts=page_facts(ref.path))
    return f"contact sheet: {path}"
