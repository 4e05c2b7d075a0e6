"""What a pixel decoder learns from: recorded frames, and what the generator makes of them.

A recorded frame is noised to a time step of the generator's schedule and denoised again. What comes out is as smooth as
what the generator samples, and shows the frame whose values are known. At several time steps it is more or less like
that frame, so that the decoder does not learn to trust every detail.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ctlev_core.diffusion.pretrained.loading import PretrainedModel
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.pixel_decoder.drawing import image_planes
from ctlev_core.pixel_decoder.options import PixelDecoderOptions
from ctlev_core.pixel_decoder.training import Places, TrainingPairs
from ctlev_core.progress import ProgressBar
from ctlev_core.realism.chain_frames import Parts, send_through
from ctlev_core.seeds import sample_seeds
from data_contracts.arrays import ArrayWriter
from data_contracts.image_rows import Images, image_chunks
from data_contracts.labels import Conditions
from data_contracts.realism_chain import Link

_CHUNK = 256


def make_pairs(
    base_model: PretrainedModel,
    frames: Images,
    values: Images,
    conditions: Conditions,
    sampling: SamplingOptions,
    options: PixelDecoderOptions,
    *,
    seed: int,
    work: Path,
    places: Places | None = None,
) -> TrainingPairs:
    """The images of every time step, kept in `work` as far as an earlier run has come.

    Args:
        base_model: the fine-tuned generator.
        frames: [N, H, W, 3] uint8 training frames.
        values: [N, P, H, W] event counts or grey levels of their pixels; with `places` also of other frames.
        conditions: N prompts, with N condition images where the generator has a ControlNet.
        sampling: how the generator's frames are sampled: palette, guidance, precision.
        options: time steps, and evaluations of the network.
        seed: of the noise.
        work: folder for the images.
        places: as of `TrainingPairs`.
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
    return TrainingPairs(values, images, conditions.images, places, conditions.made_by)


def level_planes(frames: Images, work: Path) -> np.ndarray:
    """The grey levels of frames [N, H, W, 3] as planes [N, P, H, W] uint8, in a file of the work folder.

    One plane where all frames are grey, two where none has green, else three.
    """
    is_grey, has_green = True, False
    for part in image_chunks(frames):
        is_grey = is_grey and bool((part == part[..., :1]).all())
        has_green = has_green or bool(part[..., 1].any())
    num_planes = 1 if is_grey else 3 if has_green else 2
    path = work / "levels.npy"
    with ArrayWriter(path) as written:
        for part in image_chunks(frames):
            written.append(image_planes(part, num_planes).astype(np.uint8))
    return np.load(path, mmap_mode="r", allow_pickle=False)
