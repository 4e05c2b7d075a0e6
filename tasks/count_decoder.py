"""Whole event counts for sampled images: train the decoder that draws them, and draw them."""

from __future__ import annotations

import pyarrow as pa

from ctlev_core import plugins
from ctlev_core.count_decoder.options import DECODER_FOLDER, CountDecoderOptions
from ctlev_core.events.image_grid import check_whole_counts
from ctlev_core.events.windows import spread
from ctlev_core.progress import ProgressBar
from data_contracts import tables
from data_contracts.config import EncodingChoice, SamplingChoice
from data_contracts.manifest import Manifest, conditions_of, history_table, matching_rows
from tasks.stage import Output, stage


@stage(version=1, schema=tables.TRAINING)
def train_count_decoder(
    out: Output,
    checkpoint: Manifest,
    frames: Manifest,
    conditions: Manifest,
    *,
    sampling: SamplingChoice,
    decoder: CountDecoderOptions,
    seed: int,
) -> pa.Table:
    """Learn which event counts recorded frames have where the generator draws what it draws.

    Args:
        out: of the stage; the decoder is written to `decoder/`.
        checkpoint: the fine-tuned generator.
        frames: recorded ones, with their counts.
        conditions: of the training frames among them; rows join on `sample_id`.
        sampling: how the generator is sampled; nothing depends on its solver.
        decoder: options of the decoder.
        seed: of all noise and weights.
    """
    from ctlev_core.count_decoder.files import save_decoder
    from ctlev_core.count_decoder.pairs import make_pairs
    from ctlev_core.count_decoder.training import train_count_decoder
    from ctlev_core.diffusion.sampling.devices import device_names
    from ctlev_core.diffusion.sampling.sampling import load_for_sampling

    rows, asked = matching_rows(frames, conditions), conditions_of(conditions)
    check_whole_counts(frames.array("histograms").shape, frames.array("frames").shape, "count_decoder")
    chosen = spread(len(rows), decoder.max_frames)
    rows, asked = rows[chosen], asked.take(chosen)
    plugin = plugins.load_options(sampling)
    device = device_names(plugin.options.device)[0]
    # What is learnt from need not be more exact than the decoder, and bfloat16 takes half the time.
    denoising = plugin.options.model_copy(update={"precision": decoder.precision})
    base_model = load_for_sampling(checkpoint.ref.path / "checkpoint", denoising, device, asked.images is not None)
    pairs = make_pairs(
        base_model,
        frames.images(rows, "histograms"),
        frames.images(rows),
        asked,
        denoising,
        decoder,
        seed=seed,
        work=out.work,
    )
    del base_model
    network, classes, history = train_count_decoder(pairs, decoder, seed=seed, work=out.work)
    save_decoder(out.folder / DECODER_FOLDER, network, classes, decoder, conditioned=asked.images is not None)
    return history_table(history)


@stage(version=1, schema=tables.SYNTHETIC)
def decode_counts(
    out: Output,
    decoder: Manifest,
    synthetic: Manifest,
    conditions: Manifest,
    *,
    encoding: EncodingChoice,
    options: CountDecoderOptions,
) -> pa.Table:
    """The sampled frames, drawn anew as renderings of whole event counts; their labels and seeds stay.

    Args:
        out: of the stage.
        decoder: from `train_count_decoder`.
        synthetic: sampled frames.
        conditions: that they were asked for, row by row.
        encoding: that of the recorded frames, an event histogram.
        options: number of passes, precision and device.
    """
    from ctlev_core.count_decoder.decoder import open_decoder

    opened = open_decoder(decoder.ref.path / DECODER_FOLDER, options, plugins.load_options(encoding))
    images = conditions_of(conditions).images
    redrawn = opened.redraw(synthetic.array("frames"), images, synthetic.column("seed"))
    with (
        out.open_array("frames") as written,
        ProgressBar(redrawn, total=len(synthetic), desc="counts", unit="image") as frames,
    ):
        for frame in frames:
            written.append(frame[None])
    return synthetic.table
