"""The pixel values of recorded frames for sampled images: train the decoder that draws them, and draw them."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from ctlev_core import plugins
from ctlev_core.events.windows import spread
from ctlev_core.pixel_decoder.options import DECODER_FOLDER, PixelDecoderOptions
from ctlev_core.progress import ProgressBar
from ctlev_core.seeds import distinct_seeds
from ctlev_core.supervised.frame_sequences import frame_interval_us, name_stretches, stretch_lengths
from data_contracts import tables
from data_contracts.config import EncodingChoice, SamplingChoice
from data_contracts.manifest import Manifest, conditions_of, history_table, matching_rows
from tasks.stage import Output, stage


@stage(version=2, schema=tables.TRAINING)
def train_pixel_decoder(
    out: Output,
    checkpoint: Manifest,
    frames: Manifest,
    conditions: Manifest,
    *,
    sampling: SamplingChoice,
    encoding: EncodingChoice,
    decoder: PixelDecoderOptions,
    seed: int,
) -> pa.Table:
    """Learn which pixel values recorded frames have where the generator draws what it draws.

    Event counts are learnt where frames are renderings of them, grey levels elsewhere.

    Args:
        out: of the stage; the decoder is written to `decoder/`.
        checkpoint: the fine-tuned generator.
        frames: recorded ones.
        conditions: of the training frames among them; rows join on `sample_id`.
        sampling: how the generator is sampled; nothing depends on its solver.
        encoding: that of the frames.
        decoder: options of the decoder.
        seed: of all noise and weights.
    """
    from ctlev_core.diffusion.sampling.devices import device_names
    from ctlev_core.diffusion.sampling.sampling import load_for_sampling
    from ctlev_core.pixel_decoder.files import save_decoder
    from ctlev_core.pixel_decoder.pairs import level_planes, make_pairs
    from ctlev_core.pixel_decoder.training import Places, train_pixel_decoder

    learnt, asked = matching_rows(frames, conditions), conditions_of(conditions)
    chosen = spread(len(learnt), decoder.max_frames)
    rows, asked, interval_us, places = learnt[chosen], asked.take(chosen), None, None
    shown = rows
    if decoder.previous_frame:
        interval_us = frame_interval_us(frames.table, learnt, frames.ref.path)
        before = _rows_before(frames, learnt, interval_us)[chosen]
        shown = np.unique(np.concatenate([rows, before[before >= 0]]))
        places = Places(np.searchsorted(shown, rows), np.where(before < 0, -1, np.searchsorted(shown, before)))
    whole_counts = encoding.name == "event_histogram" and _shows_counts(frames, rows)
    plugin = plugins.load_options(sampling)
    device = device_names(plugin.options.device)[0]
    # What is learnt from need not be more exact than the decoder, and bfloat16 takes half the time.
    denoising = plugin.options.model_copy(update={"precision": decoder.precision})
    base_model = load_for_sampling(checkpoint.ref.path / "checkpoint", denoising, device, asked.images is not None)
    pairs = make_pairs(
        base_model,
        frames.images(rows),
        frames.images(shown, "histograms") if whole_counts else level_planes(frames.images(shown), out.work),
        asked,
        denoising,
        decoder,
        seed=seed,
        work=out.work,
        places=places,
    )
    del base_model
    network, classes, history = train_pixel_decoder(pairs, decoder, seed=seed, work=out.work)
    save_decoder(
        out.folder / DECODER_FOLDER,
        network,
        classes,
        decoder,
        conditioned=asked.images is not None,
        whole_counts=whole_counts,
        interval_us=interval_us,
    )
    return history_table(history)


def _rows_before(frames: Manifest, rows: np.ndarray, interval_us: int) -> np.ndarray:
    """Rows [N] of the frames before those of some rows, among these; -1 where it is not one interval before."""
    names = np.array(name_stretches(frames.table, rows, interval_us))
    before = np.full(len(rows), -1)
    before[1:] = np.where(names[1:] == names[:-1], rows[:-1], -1)
    return before


def _shows_counts(frames: Manifest, rows: np.ndarray) -> bool:
    """Are the frames renderings of event counts of their own pixels, which finished event images are not?"""
    counts, images = frames.array("histograms"), frames.array("frames")
    return counts.shape[-2:] == images.shape[1:3] and all(np.array(frames.column("num_events"))[rows])


@stage(version=2, schema=tables.SYNTHETIC)
def decode_pixels(
    out: Output,
    decoder: Manifest,
    synthetic: Manifest,
    conditions: Manifest,
    *,
    encoding: EncodingChoice,
    options: PixelDecoderOptions,
) -> pa.Table:
    """The sampled frames with the pixel values of recorded ones; their labels and seeds stay.

    Args:
        out: of the stage.
        decoder: from `train_pixel_decoder`.
        synthetic: sampled frames.
        conditions: that they were asked for, row by row.
        encoding: that of the recorded frames.
        options: number of passes, precision and device.
    """
    from ctlev_core.pixel_decoder.decoder import open_decoder

    opened = open_decoder(decoder.ref.path / DECODER_FOLDER, options, plugins.load_options(encoding))
    images, lengths = conditions_of(conditions).images, None
    if opened.interval_us is not None:
        lengths = stretch_lengths(name_stretches(conditions.table, np.arange(len(conditions)), opened.interval_us))
    redrawn = opened.redraw(synthetic.array("frames"), images, distinct_seeds(synthetic.column("seed")), lengths)
    with (
        out.open_array("frames") as written,
        ProgressBar(redrawn, total=len(synthetic), desc="pixel values", unit="image") as frames,
    ):
        for frame in frames:
            written.append(frame[None])
    return synthetic.table
