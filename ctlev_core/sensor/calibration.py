"""What a recording tells of the sensor that made it, written as a preset for the DVS pixel model.

    python -m ctlev_core.sensor.calibration recording.aedat4 --out preset.yaml

Events alone do not tell everything. What is measured, and from what:

    thresholds      A pixel's reference rises by its ON threshold with each ON event and falls by its OFF threshold with
                    each OFF event. Light that comes back to where it began therefore sends n_on / n_off = threshold_off
                    / threshold_on, whatever was to be seen. Over pixels with many events, the median of that ratio is
                    the imbalance, and the spread of its logarithm, less what the unknown net change of light
                    contributes (which falls as 1 / n^2, the measured one as 1), is twice the relative variance of the
                    thresholds, if those of a pixel's two polarities are independent. A part that they share cannot be
                    seen, nor can the thresholds themselves: contrast and threshold enter as their quotient alone
    hot pixels      pixels that outdo all their neighbours, as in `ctlev_core.realism`; their share and rates
    noise           isolated events, as there, of pixels around which nothing else happens, without hot ones: those of
                    OFF are half the shot noise, those of ON the other half and the leak. How noise depends on light
                    cannot be told without pictures
    rate spread     isolated OFF events of a pixel vary more than a Poisson count if rates differ between pixels
    refractory time the shortest time between two events of a pixel, if enough are about as short; without such a pile
                    the shortest is but an upper bound. Sensors that are read out at fixed times show that period
                    instead: then nearly all short intervals are multiples of it (`interval_on_grid_share`; 0.1 by
                    chance)

What is not measured comes from a base preset and is named in the file.

Source of the noise model: Hu et al., v2e, CVPRW 2021; Nozaki and Delbruck, Temperature and parasitic photocurrent
effects in dynamic vision sensors, IEEE TED 2017 (leak events are ON events).
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, field
from pathlib import Path

import numba
import numpy as np

from ctlev_core.realism import kernels
from ctlev_core.realism.summary import HOT_FACTOR, HOT_MIN_EVENTS, RADIUS_US
from ctlev_core.sensor.options import PRESETS, SensorOptions
from data_contracts.errors import DataError
from data_contracts.events import Events

MIN_EVENTS_PER_POLARITY, MIN_RATIO_PIXELS = 12, 200
"""A pixel's ratio counts from so many events of each polarity, the spread from so many pixels."""
MIN_FREE_S = 1000.0
"""Pixel-seconds in which noise would be seen as such: a rate of 0.1 Hz is then known to a tenth."""
STILL_RADIUS_PX = 3
"""So far around a pixel nothing but noise may happen, where noise is measured."""
MIN_SPREAD_PAIRS = 200
"""Pairs of isolated OFF events within pixels, for the spread of rates."""
MIN_PILE = 20
"""Intervals within half more than the shortest, for a refractory time."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """A sensor as far as a recording shows it.

    Attributes:
        options: the preset.
        measured: what was measured, by name, with units in the name.
        assumed: names of options that come from the base preset, and why each could not be measured.
    """

    options: SensorOptions
    measured: dict[str, float] = field(default_factory=dict)
    assumed: dict[str, str] = field(default_factory=dict)


def calibrate(events: Events, base: SensorOptions = PRESETS["noisy"]) -> Calibration:
    """Estimate the options of the sensor that sent `events`; see the head of this file for what can be told.

    Args:
        events: one recording, of a scene that moves in places and rests in others; seconds are better than less.
        base: where everything else comes from, the mean ON threshold among it.
    Raises:
        DataError: no two events at different times.
    """
    if events.duration_us == 0:
        raise DataError(f"calibration: expected events over some time, got {len(events)} at one moment")
    width, height = events.sensor_size
    counts = np.zeros((2, height, width), np.int64)
    np.add.at(counts, (events.p, events.y, events.x), 1)
    is_hot = np.empty((height, width), bool)
    kernels.find_hot_pixels(counts.sum(axis=0), HOT_FACTOR, HOT_MIN_EVENTS, is_hot)
    found: dict = {"starts_settled": True}
    measured: dict[str, float] = {"duration_s": 1e-6 * events.duration_us, "num_events": float(len(events))}
    assumed = {
        name: "events alone do not tell it"
        for name in ("threshold", "threshold_minimum", "log_floor", "cutoff_dark_hz", "cutoff_bright_hz")
    }
    _measure_hot_pixels(counts, is_hot, events.duration_us, found, measured)
    _measure_noise(events, is_hot, found, measured, assumed)
    leak_events = found.get("leak_rate_hz", base.leak_rate_hz) * 1e-6 * events.duration_us
    _measure_thresholds(counts[:, ~is_hot], leak_events, base, found, measured, assumed)
    _measure_refractory(events, base, found, measured, assumed)
    return Calibration(SensorOptions(**base.model_dump() | found), measured, assumed)


def _measure_hot_pixels(counts: np.ndarray, is_hot: np.ndarray, duration_us: int, found: dict, measured: dict) -> None:
    found["hot_pixel_fraction"] = measured["hot_pixel_fraction"] = float(is_hot.mean())
    if is_hot.any():
        rates = counts[:, is_hot].sum(axis=0) / (1e-6 * duration_us)
        # The model's rates are uniform: the range of the same mean and spread, down to the lowest at most.
        mean = float(rates.mean())
        low = max(mean - math.sqrt(3) * float(rates.std()), float(rates.min()))
        found["hot_rate_hz"] = (low, 2 * mean - low)
        measured |= {"hot_rate_mean_hz": mean, "hot_rate_median_hz": float(np.median(rates))}
        measured["hot_on_share"] = float(counts[1, is_hot].sum() / counts[:, is_hot].sum())


def _measure_noise(events: Events, is_hot: np.ndarray, found: dict, measured: dict, assumed: dict) -> None:
    """Rates of isolated events outside hot pixels; a hot pixel's neighbours are never isolated and drop out."""
    keep = ~is_hot[events.y, events.x]
    t, x, y, p = (getattr(events, name)[keep] for name in "txyp")
    if len(t) == 0 or t[0] == t[-1]:
        for name in ("leak_rate_hz", "shot_noise_rate_hz", "shot_noise_rate_bright", "rate_spread"):
            assumed[name] = "nothing but hot pixels"
        return
    scratch = np.empty((2, *is_hot.shape), np.int64)
    is_isolated = np.empty(len(t), bool)
    kernels.find_isolated(t, x, y, RADIUS_US, scratch[0], scratch[1], is_isolated)
    duration_us = float(t[-1] - t[0])
    is_still = _find_still(x[~is_isolated], y[~is_isolated], is_hot)
    is_isolated &= is_still[y, x]
    free_us = np.full(is_hot.shape, duration_us)
    _take_off_covered(t, x, y, RADIUS_US, np.full(is_hot.shape, t[0]), free_us)
    free_s = 1e-6 * float(free_us[is_still].sum())
    num_on, num_off = (int(np.count_nonzero(is_isolated & (p == polarity))) for polarity in (1, 0))
    measured |= {"isolated_on_events": float(num_on), "isolated_off_events": float(num_off), "free_pixel_s": free_s}
    # Few events in much time are a measurement as well: there is little noise.
    if free_s < MIN_FREE_S:
        note = f"noise shows in {free_s:.3g} pixel-seconds without other events nearby; {MIN_FREE_S:g} are wanted"
        assumed |= {
            name: note for name in ("leak_rate_hz", "shot_noise_rate_hz", "shot_noise_rate_bright", "rate_spread")
        }
        return
    on_hz, off_hz = num_on / free_s, num_off / free_s
    found["shot_noise_rate_hz"] = measured["shot_noise_rate_hz"] = 2 * off_hz
    found["leak_rate_hz"] = measured["leak_rate_hz"] = max(on_hz - off_hz, 0.0)
    measured["leak_rate_error_hz"] = math.sqrt(num_on + num_off) / free_s
    # The rate is that at the light of the recording, whatever it was.
    found["shot_noise_rate_bright"] = 1.0
    assumed["shot_noise_rate_bright"] = "the rate is that at the light of the recording; taken as that at any light"
    off = is_isolated & (p == 0)
    cell = y[off].astype(np.int64) * is_hot.shape[1] + x[off]
    per_pixel = np.bincount(cell, minlength=is_hot.size)[is_still.ravel()]
    num_pairs = float((per_pixel * (per_pixel - 1)).sum())
    if num_pairs < MIN_SPREAD_PAIRS:
        assumed["rate_spread"] = f"{num_pairs:.0f} pairs of isolated OFF events; {MIN_SPREAD_PAIRS} are wanted"
        return
    # E[n (n - 1)] / E[n]^2 of Poisson counts is E[rate^2] / E[rate]^2, exp(s^2) of a log-normal.
    overdispersion = num_pairs / len(per_pixel) / per_pixel.mean() ** 2
    found["rate_spread"] = measured["rate_spread"] = math.sqrt(max(math.log(overdispersion), 0.0))


def _find_still(x: np.ndarray, y: np.ndarray, is_hot: np.ndarray) -> np.ndarray:
    """Pixels [H, W] that are not hot and around which next to nothing happened but noise.

    Args:
        x: px, of the events that others joined.
        y: px, of the same.
        is_hot: [H, W] bool.
    """
    import cv2

    joined = np.zeros(is_hot.shape)
    np.add.at(joined, (y, x), 1.0)
    size = 2 * STILL_RADIUS_PX + 1
    # Without the pixel itself, whose own rate must not decide whether it counts.
    around = np.maximum(cv2.boxFilter(joined, -1, (size, size), None, (-1, -1), False) - joined, 0.0)
    # Noise joins noise, too: what the quietest quarter of the pixels sees of that is taken as its measure.
    usual = float(np.quantile(around, 0.25))
    return (around <= usual + 4 * math.sqrt(usual) + 2) & ~is_hot


@numba.njit(cache=True, nogil=True)
def _take_off_covered(t, x, y, radius_us, covered_until_us, free_us):
    """Take off `free_us` [H, W] the time in which an event of that pixel would not be isolated; see `realism`."""
    height, width = free_us.shape
    for event in range(len(t)):
        end_us = min(t[event] + radius_us, t[-1])
        for row in range(max(np.int64(y[event]) - 1, 0), min(np.int64(y[event]) + 2, height)):
            for column in range(max(np.int64(x[event]) - 1, 0), min(np.int64(x[event]) + 2, width)):
                if row != y[event] or column != x[event]:
                    begin_us = max(covered_until_us[row, column], t[event] - radius_us)
                    free_us[row, column] -= max(0, end_us - begin_us)
                    covered_until_us[row, column] = end_us


def _measure_thresholds(
    counts: np.ndarray, leak_events: float, base: SensorOptions, found: dict, measured: dict, assumed: dict
) -> None:
    """From the events [2, P] (OFF, ON) of pixels that are not hot."""
    off, on = counts[0].astype(float), counts[1] - leak_events
    usable = np.minimum(on, off) >= MIN_EVENTS_PER_POLARITY
    num_pixels = int(np.count_nonzero(usable))
    measured["ratio_pixels"] = float(num_pixels)
    if num_pixels < MIN_RATIO_PIXELS:
        note = f"{num_pixels} pixels with {MIN_EVENTS_PER_POLARITY} events of each polarity; {MIN_RATIO_PIXELS} wanted"
        assumed |= {"threshold_off": note, "threshold_sigma": note}
        return
    ratio = np.log(on[usable] / off[usable])
    middle = float(np.median(ratio))
    measured["off_to_on_threshold"] = math.exp(middle)
    found["threshold_off"] = base.threshold * math.exp(middle)
    if found["threshold_off"] < base.threshold_minimum:
        found["threshold_minimum"] = base.threshold_minimum * math.exp(middle)
        assumed["threshold_minimum"] = "as far below the OFF threshold as that of the base is below its ON threshold"
    relative = _intercept((ratio - middle) ** 2, 4.0 / (on[usable] + off[usable]) ** 2)
    measured["threshold_spread"] = math.sqrt(max(relative, 0.0) / 2)
    found["threshold_sigma"] = measured["threshold_spread"] * base.threshold


def _intercept(squares: np.ndarray, ends: np.ndarray) -> float:
    """The a in squares = a + b ends, a and b >= 0: least squares over bins of equal size, robust within them.

    Squared deviations of a bin count with their median (0.455 of the mean for normal ones), so that pixels whose light
    did not come back do not decide.
    """
    order = np.argsort(ends)
    bins = np.array_split(order, min(20, len(order) // 50 + 1))
    variance = np.array([np.median(squares[part]) / 0.4549 for part in bins])
    end = np.array([ends[part].mean() for part in bins])
    # All bins weigh the same: weights by their variance would prefer those that happen to vary little.
    slope = max(float(np.polyfit(end, variance, 1)[0]), 0.0) if len(bins) > 1 else 0.0
    return max(float(variance.mean() - slope * end.mean()), 0.0)


def _measure_refractory(events: Events, base: SensorOptions, found: dict, measured: dict, assumed: dict) -> None:
    pixel = events.y.astype(np.int64) * events.sensor_size[0] + events.x
    order = np.argsort(pixel, kind="stable")
    intervals_us = np.diff(events.t[order])[np.diff(pixel[order]) == 0]
    if len(intervals_us) == 0:
        assumed["refractory_us"] = "no pixel has two events"
        return
    shortest_us = int(intervals_us.min())
    pile = int(np.count_nonzero(intervals_us <= 1.5 * shortest_us))
    measured |= {"shortest_interval_us": float(shortest_us), "intervals_about_as_short": float(pile)}
    # Some sensors are read out at fixed times: then intervals are multiples of a period, and not the pixel's silence.
    short = intervals_us[intervals_us < 10 * shortest_us]
    off_grid_us = np.abs(short - shortest_us * np.rint(short / shortest_us))
    if shortest_us >= 20:
        measured["interval_on_grid_share"] = float(np.mean(off_grid_us <= 0.05 * shortest_us))
    if pile >= MIN_PILE:
        found["refractory_us"] = shortest_us
    else:
        found["refractory_us"] = min(base.refractory_us, shortest_us)
        assumed["refractory_us"] = (
            f"at most {shortest_us} us, the shortest interval, but {pile} are about as short; {MIN_PILE} are wanted"
        )


def write_preset(path: Path, calibration: Calibration, recording: str) -> None:
    """Write a YAML file that `dvs_pixel.read_preset` reads, with what is measured and assumed as comments."""
    import yaml

    lines = [f"# Sensor preset, estimated from {recording} by ctlev_core.sensor.calibration.", "# Measured:"]
    lines += [f"#   {name}: {value:.6g}" for name, value in calibration.measured.items()]
    lines += ["# Assumed, from the base preset:"]
    lines += [f"#   {name}: {reason}" for name, reason in calibration.assumed.items()]
    options = yaml.safe_dump(calibration.options.model_dump(mode="json"), sort_keys=False)
    path.write_text("\n".join(lines) + "\n" + options, encoding="utf-8")


def main(arguments: list[str] | None = None) -> None:
    """The command line."""
    from ctlev_core.events.files import read_events_file
    from ctlev_core.sensor.options import read_preset

    parser = argparse.ArgumentParser(
        prog="python -m ctlev_core.sensor.calibration",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("recording", type=Path, help="event file of any known format")
    parser.add_argument("--out", type=Path, required=True, help="the preset, YAML")
    parser.add_argument("--base", default="noisy", help="for what cannot be measured: a preset's name, or a YAML file")
    chosen = parser.parse_args(arguments)
    if not chosen.out.parent.is_dir():
        raise DataError(f"--out {chosen.out}: no folder {chosen.out.parent} to write into")
    base = PRESETS.get(chosen.base) or read_preset(Path(chosen.base))
    calibration = calibrate(read_events_file(chosen.recording), base)
    write_preset(chosen.out, calibration, chosen.recording.name)
    print(chosen.out.read_text(encoding="utf-8"), end="")


if __name__ == "__main__":
    try:
        main()
    except DataError as error:
        raise SystemExit(f"error: {error}") from None
