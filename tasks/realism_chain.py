"""Where a generator loses realism: recorded frames after each of its parts, against what they were."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from ctlev_core import plugins
from ctlev_core.pixel_decoder.options import DECODER_FOLDER, PixelDecoderOptions
from ctlev_core.postprocessing.stochastic_rounding import round_frames, training_counts
from ctlev_core.realism.chain import measure_processed, measure_recorded, summarise_recordings
from ctlev_core.realism.two_sample import choose_rows
from ctlev_core.seeds import sample_seeds
from data_contracts import tables
from data_contracts.config import EncodingChoice, SamplingChoice
from data_contracts.manifest import Manifest, conditions_of, matching_rows
from data_contracts.realism_chain import Link
from data_contracts.training_sets import RECORDED
from tasks.stage import Output, stage

if TYPE_CHECKING:  # torch, which most plans do without
    from ctlev_core.realism.chain_frames import Rounding


@stage(version=4, schema=tables.CHAIN_FRAMES)
def chain_frames(
    out: Output,
    checkpoint: Manifest,
    frames: Manifest,
    conditions: Manifest,
    decoder: Manifest | None = None,
    *,
    sampling: SamplingChoice,
    link: Link,
    rounding: EncodingChoice | None,
    decoding: PixelDecoderOptions | None = None,
    seed: int,
) -> pa.Table:
    """What recorded frames become in one part of the generator.

    Args:
        out: of the stage.
        checkpoint: the fine-tuned generator.
        frames: recorded ones.
        conditions: of those of them that are sent through; rows join on `sample_id`.
        sampling: the generator's sampling options; with `link` of kind `sampled` their steps are the link's.
        link: the part.
        decoder: the pixel decoder that draws the levels, if any.
        rounding: the encoding whose levels sampled frames are rounded to or drawn as, if any.
        decoding: how the decoder draws.
        seed: of all noise.
    """
    rows = matching_rows(frames, conditions)
    seeds = sample_seeds(seed, len(rows))
    round_frames = None
    if rounding is not None:
        round_frames = _rounding(frames, plugins.load_options(rounding), decoder, decoding)
    with out.open_array("frames") as written:
        for made in _send(out, checkpoint, frames, conditions, rows, sampling, link, round_frames, seeds):
            written.append(made)
    return pa.table(
        {
            "sample_id": conditions.table["sample_id"],
            "recording_id": frames.table["recording_id"].take(rows),
            "seed": pa.array(seeds, pa.int64()),
        }
    )


def _send(
    out: Output,
    checkpoint: Manifest,
    frames: Manifest,
    conditions: Manifest,
    rows: np.ndarray,
    sampling: SamplingChoice,
    link: Link,
    round_frames: Rounding | None,
    seeds: list[int],
) -> Iterator[np.ndarray]:
    """Batches of frames after the part."""
    from ctlev_core.diffusion.sampling.devices import device_names
    from ctlev_core.diffusion.sampling.sampling import load_for_sampling
    from ctlev_core.realism.chain_frames import Parts, send_through

    plugin, asked = plugins.load_options(sampling), conditions_of(conditions)
    folder = checkpoint.ref.path / "checkpoint"
    if link.kind == "sampled":
        made = plugin.module.sample(folder, asked, plugin.options, seeds=seeds, work=out.work)
        yield made if round_frames is None else round_frames(made, asked.images, seeds)
        return
    device = device_names(plugin.options.device)[0]
    base_model = load_for_sampling(folder, plugin.options, device, asked.images is not None)
    recorded = np.asarray(frames.array("frames")[rows])
    yield from send_through(link, recorded, asked, Parts(base_model, plugin.options, round_frames), seeds)


def _rounding(
    frames: Manifest, encoder: plugins.Plugin, decoder: Manifest | None, decoding: PixelDecoderOptions | None
) -> Rounding:
    """To whole counts: drawn by the decoder, or else rounded to as many as training windows have."""
    if decoder is None or decoding is None:
        num_events = training_counts(frames)
        return lambda made, _, seeds: round_frames(made, num_events, encoder, seeds)
    from ctlev_core.pixel_decoder.decoder import open_decoder

    opened = open_decoder(decoder.ref.path / DECODER_FOLDER, decoding, encoder)
    return lambda made, images, seeds: np.stack(list(opened.redraw(made, images, seeds)))


@stage(version=3, schema=tables.REALISM_CHAIN)
def chain_realism(
    out: Output, frames: Manifest, conditions: Manifest, processed: list[Manifest], *, links: list[Link], seed: int
) -> pa.Table:
    """How real frames look after each part of the generator, the recorded ones themselves first.

    Args:
        out: of the stage.
        frames: recorded ones.
        conditions: of those of them that were sent through.
        processed: what they became, one artefact a link.
        links: the parts.
        seed: of halvings, networks, resampling, and of the frames behind the floor.
    """
    rows = matching_rows(frames, conditions)
    recorded, groups = np.asarray(frames.array("frames")[rows]), _recordings(frames, rows)
    split = frames.column("split")[int(rows[0])]
    several = frames.rows_where(split=split)
    several = several[choose_rows(len(several), 2 * len(rows), seed)]
    halved = np.asarray(frames.array("frames")[several])
    found = measure_recorded(recorded, groups, halved, _recordings(frames, several), seed)
    table = [{"link": RECORDED, "amount": 0, "evaluations": 0} | one.row() for one in found]
    summaries = summarise_recordings(recorded, groups)
    for link, made in zip(links, processed, strict=True):
        same = {"link": link.kind, "amount": link.amount, "evaluations": _evaluations(link)}
        found = measure_processed(np.asarray(made.array("frames")), recorded, groups, summaries, seed)
        table += [same | one.row() for one in found]
    return pa.Table.from_pylist(table, schema=tables.REALISM_CHAIN.arrow())


def _evaluations(link: Link) -> int:
    """Of the network, an image; guided steps count once."""
    if link.kind == "denoised":
        from ctlev_core.diffusion.sampling.partial_denoising import denoising_times

        return len(denoising_times(link.amount, link.max_evaluations))
    return link.amount


def _recordings(frames: Manifest, rows: np.ndarray) -> list[str]:
    return frames.table["recording_id"].take(rows).to_pylist()
