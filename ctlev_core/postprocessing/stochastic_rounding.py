"""Whole event counts from the grey values of a sampled image, by stochastic rounding.

A decoder spreads what it is unsure of: where every other recorded window has one event it gives half of one, and such
values no recorded image has. Stochastic rounding keeps the expected count of each pixel, so that sparse noise stays as
dense as it was; the most probable count, which `ctlev_core.postprocessing.image_counts` finds, would remove it.

Images that are normalised one by one say nothing about the number of events: it is that of a recorded window drawn at
random. Where the same count has the same value in every image (normalisation `count`) the image says it itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctlev_core.events.image_grid import check_whole_counts
from ctlev_core.plugins import Plugin
from data_contracts.errors import DataError
from data_contracts.manifest import Manifest


def round_stochastically(
    frames: np.ndarray,
    num_events: np.ndarray,
    *,
    polarity: bool,
    seeds: Sequence[int],
    events_of_level: np.ndarray | None = None,
) -> np.ndarray:
    """Counts of each image: floor(expected count + u), u uniform between 0 and 1.

    Args:
        frames: [N, H, W, 3] uint8; with polarity red = positive and blue = negative (green is not looked at), without
            the mean of the channels counts.
        num_events: [R] events in each of R >= 1 recorded windows.
        polarity: of the event histogram.
        seeds: N seeds; a row depends on its own alone.
        events_of_level: [256] of each grey level, the same in every image; None = in proportion to levels, as many as
            make the number of events drawn.
    Returns:
        [N, C, H, W] uint16, two channels with polarity. A black image stays without events.
    Raises:
        ValueError: another shape or dtype, another number of seeds, or no recorded window.
    """
    if frames.ndim != 4 or frames.shape[3] != 3 or frames.dtype != np.uint8:
        raise ValueError(f"frames must be [N, H, W, 3] uint8, got {frames.shape} {frames.dtype}")
    if len(seeds) != len(frames) or not len(num_events):
        raise ValueError(
            f"expected one seed a frame and recorded windows, got {len(seeds)} seeds for {len(frames)} frames and "
            f"{len(num_events)} windows"
        )
    channels = 2 if polarity else 1
    counts = np.zeros((len(frames), channels, *frames.shape[1:3]), np.uint16)
    for row, seed in enumerate(seeds):
        rng = np.random.default_rng(seed)
        values = frames[row][..., [0, 2]] if polarity else frames[row].mean(axis=2, keepdims=True)
        total = values.sum(dtype=np.float64)
        if total == 0:
            continue
        if events_of_level is None:
            expected = values * (rng.choice(num_events) / total)
        else:
            expected = np.interp(values, np.arange(256), events_of_level)
        counts[row] = np.minimum(expected + rng.random(expected.shape), 65535).transpose(2, 0, 1)
    return counts


def training_counts(frames: Manifest) -> np.ndarray:
    """Events [R] in the image of each training window, which `round_stochastically` draws from.

    Args:
        frames: recorded, with their histograms.
    Raises:
        DataError: the event counts of their pixels are not known.
    """
    histograms = frames.array("histograms")
    check_whole_counts(histograms.shape, frames.array("frames").shape, "stochastic_rounding")
    if not all(frames.column("num_events")):
        raise DataError(
            f"{frames.ref.path}: stochastic_rounding needs event counts, and there are windows without any, as "
            "finished event images are; set stochastic_rounding=false"
        )
    return np.array([histograms[row].sum(dtype=np.int64) for row in frames.rows_where(split="train")])


def round_frames(frames: np.ndarray, num_events: np.ndarray, encoder: Plugin, seeds: Sequence[int]) -> np.ndarray:
    """Images [N, H, W, 3] uint8 as renderings of whole event counts, likewise.

    Args:
        frames: [N, H, W, 3] uint8.
        num_events: [R] events in each of R >= 1 recorded windows.
        encoder: an event histogram, that of the recorded windows.
        seeds: N seeds; a row depends on its own alone.
    """
    options, events_of_level = encoder.options, None
    if options.normalisation == "count":
        events_of_level = _events_of_level(options.full_scale_count)
    counts = round_stochastically(
        frames, num_events, polarity=options.polarity, seeds=seeds, events_of_level=events_of_level
    )
    return encoder.module.render_image(counts, encoder.options)


def _events_of_level(full_scale_count: int) -> np.ndarray:
    """Counts [256] that grey levels stand for where a count k is drawn as floor(255 k / full scale), and 255 at most.

    In proportion between the levels of two counts, for a decoder that is unsure which it is gives their mean. Where
    several counts share a level, their mean.
    """
    counts = np.arange(min(full_scale_count, 65_535) + 1)
    levels, place, number = np.unique(255 * counts // full_scale_count, return_inverse=True, return_counts=True)
    means = np.bincount(place, counts) / number
    means[0] = 0.0  # black, whatever was lost in it, stays without events
    return np.interp(np.arange(256), levels, means)
