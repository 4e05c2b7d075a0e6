"""One self-contained HTML page of the experiment, and the same tables as Parquet."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ctlev_core.intervals import MIN_RECORDINGS, bootstrap_interval
from ctlev_core.realism.distances import DISTRIBUTIONS
from ctlev_core.report.contact_sheet import contact_sheet_sections
from ctlev_core.report.copies import copy_sections
from ctlev_core.report.html import Animation, Curves, ImageGrid, Section, Table, render_report
from ctlev_core.report.realism import realism_sections
from ctlev_core.report.verdict import Difference, lower_is_better, verdict
from data_contracts import tables
from data_contracts.manifest import RUN_FILE, Manifest, ManifestRef
from tasks.stage import Output, stage

GRID_COLUMNS = 10
FEWEST_MOVING = 8
"""Frames in the order of time that are worth an animation."""
MAX_CLIPS = 6
_TABLES = ("scores", "realism", "recordings")


@stage(version=7, schema=tables.REPORT)
def report(
    out: Output,
    recordings: Manifest,
    frames: Manifest,
    frame_conditions: Manifest,
    conditions: Manifest,
    checkpoints: list[Manifest],
    generated: list[Manifest],
    scores: list[Manifest],
    models: list[Manifest],
    realism: Manifest,
    copies: list[Manifest],
    *,
    title: str,
    notice: str,
    settings: Sequence[str],
    generator_names: Sequence[str],
    checkpoint_names: Sequence[str],
    model_names: Sequence[str],
) -> pa.Table:
    """Write `report.html`, `scores.parquet`, `realism.parquet` and `recordings.parquet`.

    `generated` are the frames of each generator: first the experiment's own, called `synthetic`, then the baselines.
    """
    all_scores = pa.concat_tables([manifest.table for manifest in scores])
    rows = all_scores.to_pylist()
    headline, *details = _score_tables(rows, settings)
    sections: list[Section] = [
        headline,
        *_compared_with_baselines(scores, generator_names),
        _grid("Asked for, and sampled", conditions, dict(zip(generator_names, generated, strict=True))),
        *_motion(conditions, generated[0]),
        _real_grid(frames),
        *details,
        *copy_sections(frames, generated, copies),
        *contact_sheet_sections(frames, frame_conditions, conditions),
        *realism_sections(realism.table.to_pylist(), realism.attached(DISTRIBUTIONS).to_pylist()),
        *[
            _curves(f"Training of the generator: {name}", [checkpoint], [name])
            for name, checkpoint in zip(checkpoint_names, checkpoints, strict=True)
        ],
        _curves("Downstream training", models, model_names),
        _recordings_table(recordings, frames),
        _cost_table(
            [
                recordings,
                frames,
                frame_conditions,
                conditions,
                *checkpoints,
                *generated,
                *models,
                *scores,
                realism,
                *copies,
            ]
        ),
    ]
    own, *others = generator_names
    beside = {other: _difference(scores, f"real+{other}", f"real+{own}") for other in others}
    page = render_report(
        title=title,
        lead=notice,
        verdict=verdict(rows, settings, _difference(scores, "real", f"real+{own}"), beside),
        sections=sections,
    )
    (out.folder / "report.html").write_text(page, encoding="utf-8")
    pq.write_table(all_scores, out.folder / "scores.parquet")
    pq.write_table(realism.table, out.folder / "realism.parquet")
    pq.write_table(recordings.table, out.folder / "recordings.parquet")
    return pa.table({"table": list(_TABLES), "file": [f"{name}.parquet" for name in _TABLES]})


def _difference(scores: list[Manifest], first: str, second: str) -> Difference | None:
    """The second setting minus the first, sample by sample over the same test data, with its interval over recordings.

    In the first metric, and of the mean over seeds; None where one of the settings was not scored.
    """
    values: dict[str, list[np.ndarray]] = {first: [], second: []}
    recordings: list[str] = []
    for manifest in scores:
        setting = manifest.column("setting")[0]
        if setting in values and f"{tables.SAMPLE_SCORES.name}.parquet" in manifest.files:
            table = manifest.attached(tables.SAMPLE_SCORES)
            of_first_metric = [name == table["metric"][0].as_py() for name in table["metric"].to_pylist()]
            table = table.filter(pa.array(of_first_metric))
            values[setting].append(table["value"].to_numpy(zero_copy_only=False))
            recordings = table["recording_id"].to_pylist()
    if not all(values.values()):
        return None
    before, after = (np.mean(np.stack(of_seeds), axis=0) for of_seeds in values.values())
    low = high = float("nan")
    if len(set(recordings)) >= MIN_RECORDINGS:
        low, high = bootstrap_interval(after - before, recordings)
    return Difference(float(np.nanmean(after - before)), low, high)


def _compared_with_baselines(scores: list[Manifest], generator_names: Sequence[str]) -> list[Section]:
    """What the experiment's own frames are worth beside those of each baseline."""
    own, *others = generator_names
    body: list[list[str]] = []
    bold: set[tuple[int, int]] = set()
    for other in others:
        row = [other]
        for first, second in ((other, own), (f"real+{other}", f"real+{own}"), ("real", f"real+{other}")):
            difference = _difference(scores, first, second)
            if difference is None:
                row.append("")
                continue
            if difference.low > 0 or difference.high < 0:
                bold.add((len(body), len(row)))
            interval = "" if np.isnan(difference.low) else f" [{difference.low:+.3f}, {difference.high:+.3f}]"
            row.append(f"{difference.value:+.3f}{interval}")
        body.append(row)
    if not body:
        return []
    columns = ["baseline", f"{own} - baseline", f"real+{own} - real+baseline", "real+baseline - real"]
    caption = (
        "Differences in the first metric, sample by sample on the same held-out frames; in brackets 95 % over test "
        "recordings. Bold: the interval excludes 0. All generators were asked for the same labels; those that learn, "
        "learnt from the same frames."
    )
    return [Table("Beside the baselines", columns, body, caption=caption, bold=bold)]


def publish_report(ref: ManifestRef, home: Path, name: str) -> str:
    """Put the newest report of an experiment where a person looks for it, and say where that is."""
    folder = home / "reports"
    (folder / name).mkdir(parents=True, exist_ok=True)
    for table in _TABLES:
        shutil.copyfile(ref.path / f"{table}.parquet", folder / name / f"{table}.parquet")
    temporary = folder / f".{name}.html"
    shutil.copyfile(ref.path / "report.html", temporary)
    temporary.replace(folder / f"{name}.html")
    return f"report: {folder / f'{name}.html'}"


def _score_tables(rows: list[dict[str, Any]], settings: Sequence[str]) -> list[Section]:
    scored = [row for row in rows if row["task"] != "distance"]
    trained = [row for row in scored if row["setting"] in settings and row["group"] == "all"]
    faithful = [row for row in scored if row["setting"].startswith("labels of ") and row["group"] == "all"]
    distances = [row for row in rows if row["task"] == "distance"]
    seeds = len({row["seed"] for row in trained})
    sections: list[Section] = [
        _pivot(
            "Does synthetic data help? Held-out real test data",
            trained,
            "trained on",
            f"Equal optimiser steps for every row; mean over {seeds} seed{'s' if seeds > 1 else ''}. In brackets the "
            "95 % interval over test recordings (cluster bootstrap), which does not cover the spread over seeds.",
        )
    ]
    floor = [{**row, "setting": "held-out real (floor)"} for row in trained if row["setting"] == "real"]
    if faithful:
        sections.append(
            _pivot(
                "Do the synthetic frames show their labels?",
                floor + faithful,
                "frames",
                "The model trained on real frames, scored on synthetic frames against the labels they were sampled "
                "from, beside its score on held-out real frames.",
            )
        )
    if distances:
        sections.append(
            _pivot(
                "How far from real frames?",
                distances,
                "frames",
                "Frechet distance to the real training frames in the features of a classifier trained on real events "
                "(not FID). It depends on the number of frames, so read it against the row of held-out real frames; "
                "alone it does not tell whether labels are right. In brackets 95 %, from halves by recording.",
            )
        )
    groups = [row for row in scored if row["setting"] in settings and row["group"] != "all"]
    if groups:
        sections.append(_group_table(groups, settings))
    return sections


def _pivot(title: str, rows: list[dict[str, Any]], first: str, caption: str) -> Table:
    """Settings down, metrics across."""
    metrics = list(dict.fromkeys(row["metric"] for row in rows))
    body = []
    for setting in dict.fromkeys(row["setting"] for row in rows):
        of_setting = [row for row in rows if row["setting"] == setting]
        cells = [_cell([row for row in of_setting if row["metric"] == metric]) for metric in metrics]
        body.append([setting, *cells, of_setting[0]["num_train"], of_setting[0]["num_samples"]])
    arrows = [f"{metric} {'↓' if lower_is_better(metric) else '↑'}" for metric in metrics]
    return Table(title, [first, *arrows, "frames trained on", "frames scored"], body, caption=caption)


def _cell(rows: list[dict[str, Any]]) -> str:
    if not rows:
        return ""
    value = float(np.mean([row["value"] for row in rows]))
    if any(row["low"] is None or row["high"] is None for row in rows):
        return f"{value:.3f}"
    low, high = (float(np.mean([row[end] for row in rows])) for end in ("low", "high"))
    return f"{value:.3f} [{low:.3f}, {high:.3f}]"


def _group_table(rows: list[dict[str, Any]], settings: Sequence[str]) -> Table:
    metric = rows[0]["metric"]
    rows = [row for row in rows if row["metric"] == metric]
    body = []
    for group in dict.fromkeys(row["group"] for row in rows):
        of_group = [row for row in rows if row["group"] == group]
        cells = [_cell([row for row in of_group if row["setting"] == setting]) for setting in settings]
        body.append([group, *cells, of_group[0]["num_samples"]])
    return Table(f"{metric}, class by class", ["class", *settings, "frames scored"], body)


def _grid(title: str, conditions: Manifest, generated: dict[str, Manifest]) -> ImageGrid:
    synthetic = next(iter(generated.values()))
    chosen = np.linspace(0, len(synthetic) - 1, min(GRID_COLUMNS, len(synthetic))).astype(int)
    rows: list[tuple[str, list[np.ndarray]]] = []
    if "images.npy" in conditions.files:
        rows.append(("condition", [conditions.array("images")[row] for row in chosen]))
    for name, frames in generated.items():
        rows.append((name, [frames.array("frames")[row] for row in chosen]))
    captions = [synthetic.column("class_name")[row] for row in chosen]
    return ImageGrid(title, rows, column_labels=captions, caption="One column a sample, none chosen by eye.")


def _motion(conditions: Manifest, synthetic: Manifest) -> list[Section]:
    """Conditions beside the frames sampled for them, as they follow in time, where they do."""
    if "images.npy" not in conditions.files:
        return []
    runs = [run for run in _runs(synthetic.column("source_id")) if len(run[1]) >= FEWEST_MOVING][:MAX_CLIPS]
    if not runs:
        return []
    clips = []
    for _, rows, _ in runs:
        pictures = [np.asarray(array[rows]) for array in (conditions.array("images"), synthetic.array("frames"))]
        clips.append((synthetic.column("class_name")[rows[0]], np.concatenate(pictures, axis=2)))
    step_us = float(np.median([step for _, _, step in runs]))
    caption = "Left the condition, right the frame sampled for it; every frame is sampled on its own."
    return [Animation("In motion", clips, 1e6 / step_us, caption)]


def _runs(source_ids: list[str]) -> list[tuple[str, np.ndarray, float]]:
    """Rows that follow one another in the time of one recording: its name, the rows, the median step in us."""
    found: list[tuple[str, list[int], list[int]]] = []
    for row, source_id in enumerate(source_ids):
        name, _, time = source_id.rpartition(":")
        t_us = int(time) if time.isdecimal() else -1
        if found and found[-1][0] == name and 0 <= found[-1][2][-1] < t_us:
            found[-1][1].append(row)
            found[-1][2].append(t_us)
        else:
            found.append((name, [row], [t_us]))
    return [(name, np.array(rows), float(np.median(np.diff(times)))) for name, rows, times in found if len(rows) > 1]


def _real_grid(frames: Manifest) -> ImageGrid:
    rows: list[tuple[str, list[np.ndarray]]] = []
    for split in ("train", "test"):
        members = frames.rows_where(split=split)
        chosen = members[np.linspace(0, len(members) - 1, min(GRID_COLUMNS, len(members))).astype(int)]
        rows.append((f"real, {split}", [frames.array("frames")[row] for row in chosen]))
    return ImageGrid("Real frames", rows, caption="The data the generator was tuned on, and the data tested on.")


def _curves(title: str, manifests: list[Manifest], names: Sequence[str]) -> Curves:
    series: dict[str, tuple[list[float], list[float]]] = {}
    for manifest, name in zip(manifests, names, strict=True):
        for curve in dict.fromkeys(manifest.column("curve")):
            rows = [row for row in manifest.table.to_pylist() if row["curve"] == curve]
            series[f"{name}, {curve}"] = ([row["step"] for row in rows], [row["loss"] for row in rows])
    return Curves(title, series, x_label="optimiser step", y_label="loss")


def _recordings_table(recordings: Manifest, frames: Manifest) -> Table:
    """Recordings added up by split and class, with their events."""
    table = recordings.table.to_pylist()
    frame_rows = list(zip(frames.column("recording_id"), strict=True))
    frames_of: dict[str, int] = {}
    for (name,) in frame_rows:
        frames_of[name] = frames_of.get(name, 0) + 1
    body = []
    for key in dict.fromkeys((row["splits"], row["class_name"]) for row in table):
        members = [row for row in table if (row["splits"], row["class_name"]) == key]
        body.append(
            [
                *key,
                len(members),
                len({row["subject"] for row in members}),
                sum(row["num_events"] for row in members),
                sum(row["num_positive"] for row in members),
                sum(row["num_negative"] for row in members),
                round(sum(row["duration_us"] for row in members) / 1e6, 4),
                sum(frames_of.get(row["recording_id"], 0) for row in members),
            ]
        )
    columns = ["split", "class", "recordings", "subjects", "events", "ON", "OFF", "seconds", "frames"]
    return Table("Recordings", columns, body, caption="Splits are fixed at ingest. `condition`: labels without events.")


def _cost_table(manifests: list[Manifest]) -> Table:
    """What each stage took when it was computed, which may have been in an earlier run."""
    totals: dict[str, list[float]] = {}
    for manifest in {manifest.ref.key: manifest for manifest in manifests}.values():
        record = json.loads((manifest.ref.path / RUN_FILE).read_text())
        entry = totals.setdefault(record["stage"], [0, 0.0, 0.0, 0.0])
        entry[0] += 1
        entry[1] += record["wall_seconds"]
        entry[2] += record["cpu_seconds"]
        entry[3] = max(entry[3], record["process_peak_memory_mib"])
    body = [
        [name, count, round(wall, 1), round(cpu, 1), round(peak)] for name, (count, wall, cpu, peak) in totals.items()
    ]
    columns = ["stage", "runs", "wall seconds", "CPU seconds", "peak memory of the process, MiB"]
    return Table("What it cost", columns, body, caption="As computed, which may have been in an earlier run.")
