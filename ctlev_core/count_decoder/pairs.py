"""What a count decoder learns from: recorded frames, and what the generator makes of them.

A recorded frame is noised to a time step of the generator's schedule and denoised again. What comes out is as smooth as
what the generator samples, and shows the frame whose counts are known. At several time steps it is more or less like
that frame, so that the decoder does not learn to trust every detail.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ctlev_core.count_decoder.options import CountDecoderOptions
from ctlev_core.count_decoder.training import TrainingPairs
from ctlev_core.diffusion.pretrained.loading import PretrainedModel
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.progress import ProgressBar
from ctlev_core.realism.chain_frames import Parts, send_through
from ctlev_core.seeds import sample_seeds
from data_contracts.arrays import ArrayWriter
from data_contracts.image_rows import Images
from data_contracts.labels import Conditions
from data_contracts.realism_chain import Link

_CHUNK = 256


def make_pairs(
    base_model: PretrainedModel,
    counts: Images,
    frames: Images,
    conditions: Conditions,
    sampling: SamplingOptions,
    options: CountDecoderOptions,
    *,
    seed: int,
    work: Path,
) -> TrainingPairs:
    """The images of every time step, kept in `work` as far as an earlier run has come.

    Args:
        base_model: the fine-tuned generator.
        counts: [N, P, H, W] uint16 of the training frames.
        frames: [N, H, W, 3] uint8, their event images.
        conditions: N prompts, with N condition images where the generator has a ControlNet.
        sampling: how the generator's frames are sampled: palette, guidance, precision.
        options: time steps, and evaluations of the network.
        seed: of the noise.
        work: folder for the images.
    Raises:
        DataError: frames are not of the generator's size, or its schedule has no such time step.
    """
    seeds, parts = sample_seeds(seed, len(frames)), Parts(base_model, sampling)
    images: list[Images] = []
    total = len(frames) * len(options.time_steps)
    with ProgressBar(total=total, desc="noised and denoised", unit="image") as bar:
        for time_step in options.time_steps:
            path = work / f"denoised_{time_step}.npy"
            if not path.is_file():
                link = Link(kind="denoised", amount=time_step, max_evaluations=options.evaluations)
                unfinished = path.with_name(f"unfinished_{path.name}")
                with ArrayWriter(unfinished) as written:
                    for start in range(0, len(frames), _CHUNK):
                        rows = slice(start, min(start + _CHUNK, len(frames)))
                        part = conditions.take(np.arange(rows.start, rows.stop))
                        for made in send_through(link, np.asarray(frames[rows]), part, parts, seeds[rows]):
                            written.append(made)
                            bar.update(len(made))
                unfinished.replace(path)
            images.append(np.load(path, mmap_mode="r", allow_pickle=False))
    return TrainingPairs(counts, images, conditions.images)
