"""Stretches of frames, speed against how real their time is: noise, evaluations, motion layers and their context.

    ctlev run sequences
    python benchmarks/sequences.py                        # some ten minutes on one core; of the run's own generators
    python benchmarks/sequences.py --stretches 8          # fewer, for a look

Each line samples the same labels from the same checkpoints, draws event counts by rounding or a pixel decoder, and
prints the CPU time of a stretch of 16 frames, that beside frames made one by one with as many evaluations, and the
numbers of `ctlev_core.realism.sequences`. Recorded training stretches are the first line. Target: a stretch takes at
most 1.5 times as long as 16 frames made one by one.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from ctlev_core import plugins  # noqa: E402
from ctlev_core.diffusion.pretrained.loading import PretrainedModel, conditions_to_tensor  # noqa: E402
from ctlev_core.diffusion.pretrained.prompts import encode_prompts  # noqa: E402
from ctlev_core.diffusion.sampling.options import SamplingOptions, noise_seeds  # noqa: E402
from ctlev_core.diffusion.sampling.sampling import decode_frames, load_for_sampling, sample_latents  # noqa: E402
from ctlev_core.pixel_decoder.decoder import open_decoder  # noqa: E402
from ctlev_core.pixel_decoder.options import DECODER_FOLDER, PixelDecoderOptions  # noqa: E402
from ctlev_core.postprocessing.stochastic_rounding import round_frames, training_counts  # noqa: E402
from ctlev_core.provenance.records import Record, read_provenance  # noqa: E402
from ctlev_core.realism.sequences import LabelledJoints, estimate_numbers, measure_stretch  # noqa: E402
from ctlev_core.seeds import sample_seeds  # noqa: E402
from data_contracts.config import EncodingChoice  # noqa: E402
from data_contracts.labels import Conditions  # noqa: E402
from data_contracts.manifest import Manifest, ManifestRef, conditions_of, read_manifest  # noqa: E402

LENGTH, MEASURED, TARGET = 16, 8, 1.5
SHOWN = ("rate_correlation_lag1", "rate_correlation_lag4", "persistent_share", "polarity_kept_share", "flow_agreement",
         "still_repeat_ratio")  # fmt: skip


class Case(NamedTuple):
    """One line of the table; `context` 0 leaves motion layers out."""

    noise: str
    steps: int
    context: int
    pixels: str


ROUNDED, DECODER, BEFORE = "rounded", "decoder", "frame before"
CASES = (
    *(Case("independent", steps, 0, DECODER) for steps in (3, 5, 10, 20)),
    Case("independent", 5, 0, ROUNDED),
    *(Case("stretches", steps, 0, BEFORE) for steps in (3, 5, 10, 20)),
    Case("stretches", 5, 0, DECODER),
    Case("stretches", 5, 0, ROUNDED),
    *(Case("independent", 5, context, BEFORE) for context in (4, 8, LENGTH)),
    Case("independent", 20, LENGTH, BEFORE),
    Case("independent", 5, LENGTH, ROUNDED),
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
    run = Run(chosen.home, chosen.run, chosen.layers)
    print(f"{chosen.run}: stretches of {LENGTH} frames, seconds of one core; numbers over {MEASURED} frames")
    columns = f"{'layers':>8}{'noise':>13}{'evaluations':>13}{'context':>9}{'pixels':>14}{'s':>7}{'ratio':>7}  "
    print(columns + "".join(f"{name.replace('_', ' ')[:16]:>18}" for name in SHOWN))
    print(f"{'recorded':>{len(columns) - 2}}  {_told(_recorded(run.frames))}")
    alone: dict[int, float] = {}
    ratios: list[float] = []
    for case in CASES:
        made, seconds = run.sample(case, chosen.stretches)
        alone.setdefault(case.steps, seconds)
        ratios.append(seconds / alone[case.steps])
        numbers = _numbers(made, run.asked, np.arange(len(made)), "source_id")
        print(
            f"{'yes' if case.context else 'no':>8}{case.noise:>13}{case.steps:>13}{case.context or '':>9}"
            f"{case.pixels:>14}{seconds:7.2f}{ratios[-1]:7.2f}  {_told(numbers)}",
            flush=True,
        )
    for what, wanted in (("noise of stretches", 0), ("motion layers", LENGTH)):
        most = max(ratio for case, ratio in zip(CASES, ratios, strict=True) if case.context == wanted)
        verdict = "met" if most <= TARGET else "missed"
        print(f"{what}: at most {most:.2f} x frames made one by one, target {TARGET}: {verdict}")


class Run:
    """What a run made, and frames made of it anew.

    Args:
        home: folder of all state.
        name: of the report.
        layers: name of the baseline with motion layers.
    """

    def __init__(self, home: Path, name: str, layers: str) -> None:
        self.home = home
        records = read_provenance(home / "reports" / name / "provenance.json")
        by_role = {one.role: one for one in records}
        self.image, self.layers = by_role["checkpoint of synthetic"], by_role[f"checkpoint of {layers}"]
        self.frames, self.asked = self._open(by_role["frames"]), self._open(by_role["conditions to sample from"])
        self.sampling = next(one for one in records if one.stage == "sample").arguments["sampling"]["options"]
        encoding = by_role["frames"].arguments["encoding"]
        self.encoder = EncodingChoice(name=encoding["plugin"].rpartition("/")[2], options=encoding["options"])
        self.decoders = {
            (one.arguments["checkpoint"]["manifest"], bool(one.arguments["decoder"].get("previous_frame"))): one
            for one in records
            if one.stage == "train_pixel_decoder"
        }

    def sample(self, case: Case, stretches: int) -> tuple[np.ndarray, float]:
        """Frames of the first stretches, and CPU seconds of one."""
        threshold = self.sampling["black_threshold"] if case.pixels == ROUNDED else 0
        changed = {"noise": case.noise, "num_inference_steps": case.steps, "black_threshold": threshold}
        options = SamplingOptions(**(self.sampling | changed))
        checkpoint = self.layers if case.context else self.image
        base_model = load_for_sampling(self._folder(checkpoint) / "checkpoint", options, "cpu", with_controlnet=True)
        if base_model.motion is not None:
            base_model.motion.settings = base_model.motion.settings._replace(context=case.context)
        conditions = conditions_of(self.asked).take(slice(0, stretches * LENGTH))
        own = sample_seeds(0, len(conditions))
        seeds = noise_seeds(own, options, [LENGTH] * stretches)
        draw = self._drawer(case, checkpoint.key)
        found, seconds = [], []
        for start in range(0, len(conditions), LENGTH):
            rows = slice(start, start + LENGTH)
            began = time.process_time()
            smooth = _sample_stretch(base_model, conditions.take(rows), seeds[rows], options)
            found.append(draw(smooth, conditions.take(rows), own[rows]))
            seconds.append(time.process_time() - began)
        return np.concatenate(found), float(np.median(seconds))

    def _drawer(self, case: Case, checkpoint: str) -> Callable[[np.ndarray, Conditions, list[int]], np.ndarray]:
        """From smooth images, what they were asked for and seeds to images of whole counts."""
        encoder = plugins.load_options(self.encoder)
        if case.pixels == ROUNDED:
            counts = training_counts(self.frames)
            return lambda smooth, asked, seeds: round_frames(smooth, counts, encoder, seeds)
        record = self.decoders[checkpoint, case.pixels == BEFORE]
        options = PixelDecoderOptions(**record.arguments["decoder"])
        decoder = open_decoder(self._folder(record) / DECODER_FOLDER, options, encoder)
        return lambda smooth, asked, seeds: np.stack(list(decoder.redraw(smooth, asked.images, seeds, [len(seeds)])))

    def _folder(self, record: Record) -> Path:
        return self.home / "artefacts" / record.stage / record.key

    def _open(self, record: Record) -> Manifest:
        return read_manifest(ManifestRef(key=record.key, path=self._folder(record), digest=record.digest))


@torch.no_grad()
def _sample_stretch(
    base_model: PretrainedModel, asked: Conditions, seeds: list[int], options: SamplingOptions
) -> np.ndarray:
    assert asked.images is not None
    table = encode_prompts(base_model, [asked.prompts[0], ""])
    lengths = None if base_model.motion is None else [len(asked)]
    latents = sample_latents(
        base_model,
        table[:1].expand(len(asked), -1, -1),
        table[1:],
        conditions_to_tensor(asked.images),
        seeds,
        options,
        lengths,
    )
    return decode_frames(base_model, latents, options, seeds)


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
