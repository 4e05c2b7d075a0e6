"""Sampler and number of steps against error: timed samples, their errors, solvers with an exact score, precisions."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from ctlev_core import plugins
from ctlev_core.diffusion.sampling.options import STOCHASTIC
from ctlev_core.events.windows import spread
from ctlev_core.plugin_outputs import features_of_frames, predict_frames
from ctlev_core.realism.sampling import realism_of_real, realism_of_samples
from ctlev_core.seeds import sample_seeds
from ctlev_core.statistics.sampling_errors import (
    CPU,
    EXACT,
    FLOAT64,
    LATENT_ERROR,
    PIXEL_MAX,
    PIXEL_RMS,
    TRAJECTORY,
    WASSERSTEIN,
    FeatureSet,
    Measurement,
    costs,
    feature_errors,
    floors,
    label_error,
    pixel_error,
)
from data_contracts import tables
from data_contracts.config import DownstreamChoice, MetricChoice, SamplingChoice
from data_contracts.labels import Conditions
from data_contracts.manifest import Manifest, conditions_of
from data_contracts.speed_vs_error import ExactScoreOptions, PrecisionOptions, SamplerSetting
from tasks.stage import Output, stage


@stage(version=2, schema=tables.TIMED_SAMPLES)
def sample_timed(
    out: Output, checkpoint: Manifest, conditions: Manifest, *, sampling: SamplingChoice, num_images: int, seed: int
) -> pa.Table:
    """Some of the frames that `sample` would make with these options, and what they cost.

    Times are those of the machine and the moment at which the artefact is made.
    """
    from ctlev_core.diffusion.solver_studies.timed_sampling import sample_timed as core_sample_timed

    rows, asked, seeds = _asked(conditions, num_images, seed)
    options = plugins.load_options(sampling).options
    made = core_sample_timed(checkpoint.ref.path / "checkpoint", asked, options, seeds=seeds, work=out.work)
    out.write_array("frames", made.frames)
    return pa.table(
        {
            "condition_id": conditions.table["sample_id"].take(rows),
            "seed": pa.array(seeds, pa.int64()),
            **{
                name: getattr(made, name)
                for name in ("wall_seconds", "cpu_seconds", "unet_evaluations", "controlnet_evaluations")
            },
        }
    )


def _asked(conditions: Manifest, num_images: int, seed: int) -> tuple[np.ndarray, Conditions, list[int]]:
    """Rows of the conditions, evenly spread, with the seeds that `sample` gives to these rows."""
    rows = spread(len(conditions), num_images)
    every = conditions_of(conditions)
    images = None if every.images is None else np.asarray(every.images[rows])
    seeds = sample_seeds(seed, len(conditions))
    return rows, Conditions(tuple(every.prompts[row] for row in rows), images), [seeds[row] for row in rows]


@stage(version=5, schema=tables.SPEED_VS_ERROR)
def sampling_errors(
    out: Output,
    extractor: Manifest,
    frames: Manifest,
    conditions: Manifest,
    model: Manifest | None,
    reference: list[Manifest],
    converged: list[Manifest],
    runs: list[Manifest],
    *,
    feature_extractor: DownstreamChoice,
    downstream: DownstreamChoice,
    metric: MetricChoice,
    settings: list[SamplerSetting],
) -> pa.Table:
    """Costs and errors of each setting.

    Args:
        out: of the stage.
        extractor: the model in whose features frames are compared.
        frames: with the held-out recorded frames, split `test`.
        conditions: what was asked for.
        model: a downstream model trained on recorded frames, which says whether samples show their labels; or None.
        reference: timed samples of the reference, one a seed.
        converged: timed samples of the probability-flow equation's solution, of some of the seeds.
        runs: timed samples of every setting and seed, the seeds of a setting together.
        feature_extractor: the plug-in of `extractor`.
        downstream: the plug-in of `model`.
        metric: scores the labels.
        settings: of the reference, of what has converged, and of `runs`.
    """
    feature_plugin = plugins.load_options(feature_extractor)
    folder = extractor.ref.path / "model"

    def features(pictures: np.ndarray, groups: list[str]) -> FeatureSet:
        return FeatureSet(features_of_frames(feature_plugin, folder, pictures), np.array(groups))

    held_out = frames.rows_where(split=frames.held_out)
    recordings = np.array(frames.column("recording_id"))[held_out].tolist()
    real_frames = np.asarray(frames.array("frames")[held_out])
    real = features(real_frames, recordings)
    references = features(*_pooled(reference)[:2])
    solutions = {
        (name, seed): picture
        for manifest in converged
        for name, seed, picture in zip(
            manifest.column("condition_id"), manifest.column("seed"), manifest.array("frames"), strict=True
        )
    }
    row_of = {name: row for row, name in enumerate(conditions.column("sample_id"))}
    rows: list[dict[str, Any]] = []
    for number, (setting, manifests) in enumerate(zip(settings, _in_turn(reference, converged, runs), strict=True)):
        pictures, names, table = _pooled(manifests)
        is_reference, is_solution = number == 0, number == 1
        found = feature_errors(features(pictures, names), real, None if is_reference else references)
        found += [*floors(references), *realism_of_real(real_frames, recordings)] if is_reference else []
        found += realism_of_samples(pictures, names, real_frames, recordings)
        if setting.is_deterministic and not is_solution:
            found += _pixel_errors(pictures, table, solutions)
        if model is not None:
            labels = conditions.labels.take([row_of[name] for name in names])
            predicted = predict_frames(plugins.load_options(downstream), model.ref.path / "model", pictures)
            found.append(label_error(plugins.load_options(metric), predicted, labels))
        seconds = (table[name].to_numpy() for name in ("wall_seconds", "cpu_seconds", "controlnet_evaluations"))
        found += costs(*seconds)
        evaluations = float(np.mean(table["unet_evaluations"].to_numpy()))
        rows += _rows("generator", setting.line, setting.num_inference_steps, evaluations, found)
    return _table(rows)


def _pooled(manifests: Sequence[Manifest]) -> tuple[np.ndarray, list[str], pa.Table]:
    """Frames of all seeds, the condition of each, and the rows of the tables."""
    table = pa.concat_tables([manifest.table for manifest in manifests])
    pictures = np.concatenate([manifest.array("frames") for manifest in manifests])
    return pictures, table["condition_id"].to_pylist(), table


def _in_turn(reference: list[Manifest], converged: list[Manifest], runs: list[Manifest]) -> Iterator[list[Manifest]]:
    """The artefacts of each setting: as many of `runs` as there are seeds."""
    yield reference
    yield converged
    for start in range(0, len(runs), len(reference)):
        yield runs[start : start + len(reference)]


def _pixel_errors(
    pictures: np.ndarray, table: pa.Table, solutions: dict[tuple[str, int], np.ndarray]
) -> list[Measurement]:
    """The error against the solutions, of those rows that have one."""
    keys = list(zip(table["condition_id"].to_pylist(), table["seed"].to_pylist(), strict=True))
    known = [row for row, key in enumerate(keys) if key in solutions]
    if not known:
        return []
    targets = np.stack([solutions[keys[row]] for row in known])
    return [pixel_error(pictures[known], targets, [keys[row][0] for row in known])]


@stage(version=1, schema=tables.SPEED_VS_ERROR)
def exact_score_errors(
    out: Output, checkpoint: Manifest, *, sampling: SamplingChoice, options: ExactScoreOptions
) -> pa.Table:
    """Errors of solvers that are given the exact denoiser, on the noise schedule of a checkpoint.

    `sampling` names the generator whose solvers these are; none of its options but the solver's matters here.
    """
    from ctlev_core.diffusion.solver_studies.analytic_score import LatentMixture, distribution_floors, solver_error

    config = json.loads((checkpoint.ref.path / "checkpoint" / "scheduler" / "scheduler_config.json").read_text())
    sampling_options = type(plugins.load_options(sampling).options)
    mixture = LatentMixture.make(options.weights, options.means, options.spreads)
    drawn = {"count": options.num_values, "seed": options.seed}
    rows: list[dict[str, Any]] = []
    for name, value in distribution_floors(mixture, config, **drawn).items():
        found = [Measurement(WASSERSTEIN, EXACT, value, options.num_values)]
        rows += _rows("exact_score", name, 0, 0, found)
    for name, line in options.lines.items():
        for steps in line.steps:
            chosen = sampling_options.model_validate(line.options | {"num_inference_steps": steps})
            error = solver_error(mixture, config, chosen, **drawn)
            found = [
                Measurement(WASSERSTEIN, EXACT, error.wasserstein_1, options.num_values),
                Measurement(CPU, "", error.cpu_seconds, options.num_values),
            ]
            if chosen.scheduler not in STOCHASTIC:
                found.append(Measurement(TRAJECTORY, EXACT, error.trajectory_rms, options.num_values))
            rows += _rows("exact_score", name, steps, steps, found)
    return _table(rows)


@stage(version=1, schema=tables.SPEED_VS_ERROR)
def precision_errors(
    out: Output,
    checkpoint: Manifest,
    conditions: Manifest,
    *,
    sampling: SamplingChoice,
    options: PrecisionOptions,
    seed: int,
) -> pa.Table:
    """Errors of single trajectories in several precisions against float64."""
    from ctlev_core.diffusion.solver_studies.trajectory_precision import precision_errors as core_precision_errors

    _, asked, seeds = _asked(conditions, options.num_images, seed)
    own = plugins.load_options(sampling).options
    settings = [(name, line, steps) for name, line in options.lines.items() for steps in line.steps]
    chosen = [type(own).model_validate(line.over(own.model_dump(), steps)) for _, line, steps in settings]
    found = core_precision_errors(checkpoint.ref.path / "checkpoint", asked, chosen, seeds=seeds)
    rows: list[dict[str, Any]] = []
    for (name, _, steps), errors in zip(settings, found, strict=True):
        for error in errors:
            measured = [
                Measurement(LATENT_ERROR, FLOAT64, error.latent_error, len(seeds)),
                Measurement(PIXEL_RMS, FLOAT64, error.pixel_rms_levels, len(seeds)),
                Measurement(PIXEL_MAX, FLOAT64, error.pixel_max_levels, len(seeds)),
            ]
            rows += _rows("precision", f"{name}: {error.name}", steps, steps, measured)
    return _table(rows)


def _rows(
    study: str, line: str, num_inference_steps: int, evaluations: float, found: Sequence[Measurement]
) -> list[dict[str, Any]]:
    return [
        {
            "study": study,
            "line": line,
            "num_inference_steps": num_inference_steps,
            "evaluations": evaluations,
            **dataclasses.asdict(measurement),
        }
        for measurement in found
    ]


def _table(rows: list[dict[str, Any]]) -> pa.Table:
    for row in rows:
        row.update({end: None for end in ("low", "high") if np.isnan(row[end])})
    return pa.Table.from_pylist(rows, schema=tables.SPEED_VS_ERROR.arrow())
