"""Stretches of frames, speed against how real their time is: noise, evaluations, motion layers and their context.

    ctlev run sequences
    python benchmarks/sequences.py                        # some ten minutes on one core; of the run's own generators
    python benchmarks/sequences.py --stretches 8          # fewer, for a look

Each line samples the same labels from the same checkpoints, rounds to event counts, and prints the CPU time of a
stretch of 16 frames, that beside frames made one by one with as many evaluations, and the numbers of
`ctlev_core.realism.sequences`. Recorded training stretches are the first line. The target is the issue of speed: a
stretch takes at most 1.5 times as long as 16 frames made one by one.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from ctlev_core import plugins  # noqa: E402
from ctlev_core.diffusion.pretrained.loading import PretrainedModel, conditions_to_tensor, encode_prompts  # noqa: E402
from ctlev_core.diffusion.sampling.options import SamplingOptions, noise_seeds  # noqa: E402
from ctlev_core.diffusion.sampling.sampling import decode_frames, load_for_sampling, sample_latents  # noqa: E402
from ctlev_core.postprocessing.stochastic_rounding import round_frames, training_counts  # noqa: E402
from ctlev_core.provenance.records import Record, read_provenance  # noqa: E402
from ctlev_core.realism.sequences import LabelledJoints, estimate_numbers, measure_stretch  # noqa: E402
from ctlev_core.seeds import distinct_seeds, sample_seeds  # noqa: E402
from data_contracts.config import EncodingChoice  # noqa: E402
from data_contracts.manifest import Manifest, ManifestRef, conditions_of, read_manifest  # noqa: E402

LENGTH, MEASURED, TARGET = 16, 8, 1.5
SHOWN = ("rate_correlation_lag1", "rate_correlation_lag4", "persistent_share", "polarity_kept_share", "flow_agreement",
         "still_repeat_ratio")  # fmt: skip


class Case(NamedTuple):
    """One line of the table; `context` 0 leaves motion layers out."""

    noise: str
    steps: int
    context: int


CASES = (
    *(Case("independent", steps, 0) for steps in (3, 5, 10, 20)),
    *(Case("stretches", steps, 0) for steps in (3, 5, 10, 20)),
    *(Case("independent", steps, LENGTH) for steps in (5, 20)),
    *(Case("independent", 5, context) for context in (4, 8)),
    Case("stretches", 5, LENGTH),
)


def main() -> None:
    """Print a line for each case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--home", type=Path, default=Path(os.environ.get("CTLEV_HOME", ".ctlev")))
    parser.add_argument("--run", default="sequences", help="name of its report")
    parser.add_argument("--layers", default="motion_layers", help="the training set whose generator has motion layers")
    parser.add_argument("--stretches", type=int, default=30, help="of 16 frames each")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    records = {one.role: one for one in read_provenance(chosen.home / "reports" / chosen.run / "provenance.json")}
    image, layers = records["checkpoint of synthetic"], records[f"checkpoint of {chosen.layers}"]
    frames, asked = (_open(chosen.home, records[role]) for role in ("frames", "conditions"))
    sampled = next(one for one in records.values() if one.stage == "sample")
    given = sampled.arguments["sampling"]["options"]
    print(f"{chosen.run}: stretches of {LENGTH} frames, seconds of one core; numbers over {MEASURED} frames")
    print(f"{'layers':>8}{'noise':>13}{'evaluations':>13}{'context':>9}{'s':>7}{'ratio':>7}  "
          + "".join(f"{name.replace('_', ' ')[:16]:>18}" for name in SHOWN))  # fmt: skip
    print(f"{'recorded':>57}  {_told(_recorded(frames))}")
    alone: dict[int, float] = {}
    ratios: list[float] = []
    for case in CASES:
        options = SamplingOptions(**(given | {"noise": case.noise, "num_inference_steps": case.steps}))
        folder = chosen.home / "artefacts" / (layers if case.context else image).stage
        base_model = load_for_sampling(
            folder / (layers if case.context else image).key / "checkpoint", options, "cpu", with_controlnet=True
        )
        if case.context:
            assert base_model.motion is not None
            settings = base_model.motion.settings._replace(context=case.context)
            base_model.motion.settings = settings
        made, seconds = _sample(base_model, asked, options, chosen.stretches)
        if case.noise == "independent" and not case.context:
            alone[case.steps] = seconds
        ratio = seconds / alone[case.steps]
        ratios.append(ratio)
        numbers = _numbers(_rounded(made, frames, records["frames"]), asked, np.arange(len(made)), "source_id")
        print(f"{'yes' if case.context else 'no':>8}{case.noise:>13}{case.steps:>13}{case.context or '':>9}"
              f"{seconds:7.2f}{ratio:7.2f}  {_told(numbers)}", flush=True)  # fmt: skip
    for what, wanted in (("noise of stretches", 0), ("motion layers", LENGTH)):
        most = max(ratio for case, ratio in zip(CASES, ratios, strict=True) if case.context == wanted)
        verdict = "met" if most <= TARGET else "missed"
        print(f"{what}: at most {most:.2f} x frames made one by one, target {TARGET}: {verdict}")


def _open(home: Path, record: Record) -> Manifest:
    return read_manifest(
        ManifestRef(key=record.key, path=home / "artefacts" / record.stage / record.key, digest=record.digest)
    )


@torch.no_grad()
def _sample(
    base_model: PretrainedModel, asked: Manifest, options: SamplingOptions, stretches: int
) -> tuple[np.ndarray, float]:
    """Frames of the first stretches, and seconds of one."""
    conditions = conditions_of(asked).take(slice(0, stretches * LENGTH))
    assert conditions.images is not None
    table = encode_prompts(base_model, [conditions.prompts[0], ""])
    seeds = noise_seeds(sample_seeds(0, len(conditions)), options, [LENGTH] * stretches)
    found, seconds = [], []
    for start in range(0, len(conditions), LENGTH):
        rows = slice(start, start + LENGTH)
        images = conditions_to_tensor(conditions.images[rows])
        embeddings = table[:1].expand(LENGTH, -1, -1)
        lengths = None if base_model.motion is None else [LENGTH]
        began = time.process_time()
        latents = sample_latents(base_model, embeddings, table[1:], images, seeds[rows], options, lengths)
        found.append(decode_frames(base_model, latents, options, seeds[rows]))
        seconds.append(time.process_time() - began)
    return np.concatenate(found), float(np.median(seconds))


def _rounded(made: np.ndarray, frames: Manifest, record: Record) -> np.ndarray:
    counts = training_counts(frames)
    if counts is None:
        return made
    encoding = record.arguments["encoding"]
    choice = EncodingChoice(name=encoding["plugin"].rpartition("/")[2], options=encoding["options"])
    return round_frames(made, counts, plugins.load_options(choice), distinct_seeds(sample_seeds(0, len(made))))


def _recorded(frames: Manifest) -> Mapping[str, float]:
    return _numbers(np.asarray(frames.array("frames")), frames, frames.rows_where(split="train"), "recording_id")


def _numbers(pictures: np.ndarray, manifest: Manifest, rows: np.ndarray, named: str) -> Mapping[str, float]:
    """Of the rows, stretches of `LENGTH` behind one another, in parts of `MEASURED` frames."""
    labels = manifest.labels.take(rows)
    assert labels.joints2d is not None and labels.joint_set is not None
    names = [str(manifest.column(named)[row]).rpartition(":")[0] or manifest.column(named)[row] for row in rows]
    sums, own = [], []
    for start in range(0, len(rows) // MEASURED * MEASURED, MEASURED):
        part = slice(start, start + MEASURED)
        if len(set(names[part])) > 1:
            continue
        labelled = LabelledJoints(labels.joints2d[part], labels.joint_set)
        sums.append(measure_stretch(pictures[rows[part]][..., ::2], labelled))
        own.append(names[start])
    return {name: found.value for name, found in estimate_numbers(sums, own).items()}


def _told(numbers: Mapping[str, float]) -> str:
    return "".join(f"{numbers.get(name, float('nan')):18.2f}" for name in SHOWN)


if __name__ == "__main__":
    main()
