"""What a set of recordings, or of event images, looks like in numbers, and how far another set is from it.

Numbers of a recording (`summarise_events`; T = time between its first and last event, W x H = sensor):

    event_rate_mev_s        (events - 1) / T
    pixel_rate_hz           the same a pixel: event rate / (W H)
    positive_share          positive events / events
    active_pixel_share      pixels with an event / (W H)
    hot_pixel_share         pixels with at least 20 events and more than 10 times the second largest count of their up
                            to 8 neighbours, / (W H)
    hot_event_share         events of those pixels / events
    isolated_share          events that none of the 8 pixels around joins within 10 ms, before or after, / events
    noise_rate_hz           isolated events / (W H T - what events cover), where each event covers the 8 pixels around
                            it from 10 ms before to 10 ms after: for noise that strikes each pixel on its own at a
                            constant rate this is that rate, without a bias, whatever else happens elsewhere
    spread                  sqrt(6 (var(x) / W^2 + var(y) / H^2)) of the events' places: 1 = all over the sensor, 0 =
                            one pixel
    distributions           `pixel_rate`: log10 of events / T of each active pixel; `interval`: log10 of the time from
                            an event of a pixel to its next, 1 us and less in the first bin

Numbers of the event images of a recording (`summarise_frames`; a pixel's value is its largest channel, it is active
from 25 of 255 on: one event counts where ten are white, the faint rest that a decoder leaves does not):

    active_pixel_share      active pixels / pixels
    positive_share          sum of red / (sum of red + sum of blue); only of images with colour
    speckle_share           active pixels in 8-connected components of at most 2 pixels / active pixels
    isolated_pixel_share    active pixels without an active one among their 8 neighbours / active pixels
    hot_pixel_share         pixels of at least 128 and more than 4 times the second largest value of their neighbours,
                            / pixels
    value_mean              mean value of the active pixels
    rms_contrast            standard deviation of the values of an image / 255, mean over images
    neighbour_correlation   correlation of the values of neighbouring pixels, mean over images that are not of one value
    distributions           `value` of the active pixels; `power_spectrum`: share of each spatial frequency, whatever
                            its direction, in the power of an image without its mean, mean over images

Numbers that are not defined for a recording (no events, no time) are left out there. Sets of recordings are compared in
`realism.distances`.

Sources: the isolated events are those that a background activity filter drops (Delbruck, Frame-free dynamic digital
vision, 2008; there an event needs support from before it alone).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ctlev_core.realism import frame_statistics
from data_contracts.events import Events

RADIUS_US = 10_000
HOT_FACTOR, HOT_MIN_EVENTS = 10.0, 20
ACTIVE_VALUE = 25
SPECKLE_MAX_PX = 2


@dataclass(frozen=True)
class Axis:
    """Bins of a distribution, all of one width.

    Attributes:
        low: lower end of the first bin.
        width: of a bin, in `unit`.
        num_bins: values below the first and above the last bin count there.
        unit: of the values, and of a Wasserstein distance along this axis.
        label: for a chart.
        num_merged: neighbouring bins that a divergence takes as one: it cannot tell near from far, and the few counts
            of an event image fall on other grey levels in each.
    """

    low: float
    width: float
    num_bins: int
    unit: str
    label: str
    num_merged: int = 1

    @property
    def centres(self) -> np.ndarray:
        """[num_bins] float64."""
        return self.low + (np.arange(self.num_bins) + 0.5) * self.width


AXES = {
    "pixel_rate": Axis(-3.0, 0.1, 80, "decades", "events per second of an active pixel"),
    "interval": Axis(0.0, 0.1, 80, "decades", "microseconds between two events of a pixel"),
    "value": Axis(ACTIVE_VALUE - 0.5, 1.0, 256 - ACTIVE_VALUE, "grey levels", "value of an active pixel", 21),
    "power_spectrum": Axis(0.0, 0.03, 24, "cycles per px", "spatial frequency, cycles per px", 2),
}


@dataclass(frozen=True, eq=False)
class Summary:
    """One recording, or the images of one.

    Attributes:
        numbers: by name; those that are not defined are not there.
        distributions: [num_bins] float64 by name of the axis, adding up to 1; those without a value are not there.
    """

    numbers: Mapping[str, float] = field(default_factory=dict)
    distributions: Mapping[str, np.ndarray] = field(default_factory=dict)


def summarise_events(events: Events) -> Summary:
    """The numbers of a recording; see the head of this file.

    Takes 0.3 to 1 us an event, the more the larger the sensor.

    Args:
        events: N events, checked; a stretch of a recording that is too long gives numbers of that stretch.
    """
    from ctlev_core.realism import kernels

    if len(events) == 0:
        return Summary()
    width, height = events.sensor_size
    num_events, duration_us = len(events), events.duration_us
    counts = np.zeros((height, width), np.int64)
    axis = AXES["interval"]
    intervals = np.zeros(axis.num_bins, np.int64)
    edges_us = 10.0 ** (axis.low + axis.width * np.arange(1, axis.num_bins))
    kernels.count_and_time(events.t, events.x, events.y, edges_us, counts, intervals)
    is_hot = np.empty(counts.shape, bool)
    kernels.find_hot_pixels(counts, HOT_FACTOR, HOT_MIN_EVENTS, is_hot)
    is_isolated = np.empty(num_events, bool)
    scratch = np.empty((2, height, width), np.int64)
    covered = kernels.find_isolated(events.t, events.x, events.y, RADIUS_US, scratch[0], scratch[1], is_isolated)
    numbers = {
        "positive_share": float(events.p.mean()),
        "active_pixel_share": float((counts > 0).mean()),
        "hot_pixel_share": float(is_hot.mean()),
        "hot_event_share": float(counts[is_hot].sum() / num_events),
        "isolated_share": float(is_isolated.mean()),
        "spread": float(np.sqrt(6 * (events.x.var() / width**2 + events.y.var() / height**2))),
    }
    distributions = {}
    if duration_us > 0:
        numbers["event_rate_mev_s"] = (num_events - 1) / duration_us
        numbers["pixel_rate_hz"] = (num_events - 1) / duration_us * 1e6 / (width * height)
        rates = np.log10(counts[counts > 0] / (duration_us * 1e-6))
        distributions["pixel_rate"] = _histogram(rates, AXES["pixel_rate"])
        free = float(width * height) * duration_us - covered
        if free > 0:
            numbers["noise_rate_hz"] = float(is_isolated.sum()) / (free * 1e-6)
    if intervals.any():
        distributions["interval"] = intervals / intervals.sum()
    return Summary(numbers, distributions)


def summarise_frames(frames: np.ndarray) -> Summary:
    """The numbers of the event images of one recording; see the head of this file.

    Args:
        frames: [N, H, W, 3] uint8, red = positive, blue = negative, or three equal channels.
    Raises:
        ValueError: another shape or dtype.
    """
    import cv2

    if frames.ndim != 4 or frames.shape[3] != 3 or frames.dtype != np.uint8:
        raise ValueError(f"frames must be [N, H, W, 3] uint8, got {frames.shape} {frames.dtype}")
    num_active = num_speckle = num_isolated = num_hot = 0
    red = blue = 0
    value_counts = np.zeros(256, np.int64)
    has_colour = False
    contrasts, correlations, spectra = [], [], []
    ring_of = _bins(frame_statistics.radial_frequencies(frames.shape[1:3]), AXES["power_spectrum"]).reshape(-1)
    for frame in frames:
        values = frame.max(axis=2)
        active = values >= ACTIVE_VALUE
        value_counts += np.bincount(values.reshape(-1), minlength=256)
        _, _, statistics, _ = cv2.connectedComponentsWithStats(active.astype(np.uint8), connectivity=8)
        areas = statistics[1:, cv2.CC_STAT_AREA]
        num_active += int(active.sum())
        num_speckle += int(areas[areas <= SPECKLE_MAX_PX].sum())
        num_isolated += frame_statistics.count_isolated(active)
        num_hot += frame_statistics.count_hot(values)
        red, blue = red + int(frame[..., 0].sum(dtype=np.int64)), blue + int(frame[..., 2].sum(dtype=np.int64))
        has_colour = has_colour or bool((frame[..., 0] != frame[..., 2]).any())
        contrasts.append(frame_statistics.rms_contrast(values))
        correlations.append(frame_statistics.neighbour_correlation(values))
        shares = frame_statistics.power_shares(values)
        if shares is not None:
            spectra.append(np.bincount(ring_of, shares.reshape(-1), AXES["power_spectrum"].num_bins))
    numbers: dict[str, float] = {}
    distributions = {}
    num_pixels = frames.size // 3
    if num_pixels:
        numbers["active_pixel_share"] = num_active / num_pixels
    if has_colour:
        numbers["positive_share"] = red / (red + blue)
    if num_active:
        of_active = value_counts[ACTIVE_VALUE:]
        numbers["speckle_share"] = num_speckle / num_active
        numbers["isolated_pixel_share"] = num_isolated / num_active
        numbers["value_mean"] = float(of_active @ np.arange(ACTIVE_VALUE, 256)) / num_active
        distributions["value"] = of_active / num_active
    if num_pixels:
        numbers["hot_pixel_share"] = num_hot / num_pixels
        numbers["rms_contrast"] = float(np.mean(contrasts))
    if not np.isnan(correlations).all():
        numbers["neighbour_correlation"] = float(np.nanmean(correlations))
    if spectra:
        distributions["power_spectrum"] = np.mean(spectra, axis=0)
    return Summary(numbers, distributions)


def _histogram(values: np.ndarray, axis: Axis) -> np.ndarray:
    counts = np.bincount(_bins(values, axis), minlength=axis.num_bins)
    return counts / counts.sum()


def _bins(values: np.ndarray, axis: Axis) -> np.ndarray:
    """The bin of each value, in the shape of the values."""
    return np.clip(np.floor((values - axis.low) / axis.width), 0, axis.num_bins - 1).astype(np.int64)
