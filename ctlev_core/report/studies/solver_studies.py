"""Solvers with an exact score, and trajectories in several precisions: sections of the page on speed against error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ctlev_core.report.page.html import Section, Table
from ctlev_core.report.studies.measurement_charts import Row, chart, find_row, lines_of, rows_of
from ctlev_core.statistics.sampling_errors import (
    CPU,
    EXACT,
    FLOAT64,
    LATENT_ERROR,
    PIXEL_MAX,
    PIXEL_RMS,
    TRAJECTORY,
    WASSERSTEIN,
)


def exact_score_sections(rows: Sequence[Row]) -> list[Section]:
    """Solvers that were given the exact denoiser."""
    floors = {
        row["line"]: row["value"] for row in rows_of(rows, WASSERSTEIN, EXACT, "exact_score") if not row["evaluations"]
    }
    series = lines_of(rows, WASSERSTEIN, EXACT, "exact_score")
    if not series:
        return []
    drawn = next(row["num_samples"] for row in rows if row["study"] == "exact_score")
    noted = ", ".join(f"{name} {value:.2g}" for name, value in floors.items())
    caption = (
        f"Solvers with the exact denoiser of values like those of event images, {drawn:,} of them: no network, no "
        f"error but the solver's. Wasserstein-1 distance from the exact distribution; {noted}: less cannot be seen."
    )
    sections: list[Section] = [chart("Exact score: distribution", series, None, "", "Wasserstein-1 distance", caption)]
    paths = lines_of(rows, TRAJECTORY, EXACT, "exact_score")
    if paths:
        caption = (
            "Distance of single values from where the probability-flow equation, solved in closed form, takes them. It "
            "stays above zero because the last step, from the schedule's lowest noise to none, is one jump."
        )
        sections.append(chart("Exact score: trajectory", paths, None, "", "RMS", caption))
    body = []
    for line in series:
        for row in [row for row in rows_of(rows, WASSERSTEIN, EXACT, "exact_score") if row["line"] == line]:
            steps = row["num_inference_steps"]
            path = find_row(rows, line, steps, TRAJECTORY, EXACT, "exact_score")
            seconds = find_row(rows, line, steps, CPU, "", "exact_score")
            body.append([line, steps, *(None if found is None else found["value"] for found in (row, path, seconds))])
    columns = ["sampler", "evaluations", "Wasserstein-1", "trajectory RMS", "CPU seconds for all values"]
    return [*sections, Table("Exact score: every setting", columns, body)]


def precision_sections(rows: Sequence[Row]) -> list[Section]:
    """One trajectory in several precisions."""
    found = rows_of(rows, LATENT_ERROR, FLOAT64, "precision")
    if not found:
        return []
    body: list[list[Any]] = []
    for row in found:
        solver, _, precision = row["line"].partition(": ")
        point = row["line"], row["num_inference_steps"]
        pixels = [find_row(rows, *point, metric, FLOAT64, "precision") for metric in (PIXEL_RMS, PIXEL_MAX)]
        errors = [f"{found['value']:.2g}" for found in (row, *pixels) if found is not None]
        body.append([solver, row["num_inference_steps"], precision, *errors])
    columns = ["sampler", "steps", "precision", "error of the latents", "RMS, grey levels", "largest, grey levels"]
    caption = (
        f"{found[0]['num_samples']} images from the same noise, against float64. Error of the latents: root mean "
        "square of the difference over that of the latents."
    )
    return [Table("What rounding costs", columns, body, caption=caption)]
