"""The sensor's error against its cost, and its speed beside the algorithm of v2e.

    python benchmarks/sensor.py                    # all tables; the plot goes to sensor.png
    python benchmarks/sensor.py --part speed --frames 100

`error`: event times of signals whose crossings are known in closed form, against the number of frames: at fixed steps,
where the sensor asks for frames as pictures change (`tolerance`) or things move (`max_displacement_px`), and for
v2e at the same fixed steps. `pauses`: the frames that fixed steps need for the errors of adaptive ones, in a scene that
rests, creeps and jumps. `speed`: 346 x 260 px, one thread, with threshold mismatch, refractory time, leak, shot noise
in both; events of v2e differ in their times, and a little in number. Medians of CPU seconds over interleaved rounds.

The reference is the published algorithm in plain NumPy (Hu et al., v2e: From video frames to realistic DVS events,
CVPRW 2021, and its emulator's documentation).
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ctlev_core.sensor.adaptive_rendering import RenderingOptions, simulate_rendered
from ctlev_core.sensor.dvs_pixel import PRESETS, PixelMaps, Sensor, SensorOptions, sample_pixel_maps, simulate_events

IDEAL = PRESETS["ideal"].model_copy(update={"log_floor": 1e-4})
STEPS_US = (20_000, 10_000, 5_000, 2_000, 1_000, 500, 200, 100)
SPEED_WANTED, FRAMES_WANTED = 10.0, 4.0
REAL_TIME_WANTED = 250.0, 5.0
"""Frames a second, and times v2e's speed, of the scene in which everything moves, low-pass and noise on."""
STOP_US = 1_000_000
PIXELS = 48


@dataclass(frozen=True)
class Signal:
    """Light of PIXELS pixels in a row: `intensity(t_s) -> [1, PIXELS]`, and `crossings(k)` of pixel k in us."""

    name: str
    intensity: Callable[[float], np.ndarray]
    crossings: Callable[[int], list[float]]
    speed_bound: Callable[[float, float], float] | None = None


def main() -> None:
    """Print the tables, draw the plot, say which targets were missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=("all", "error", "speed"), default="all")
    parser.add_argument("--frames", type=int, default=60, help="frames of each scene of `speed`")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--plot", type=Path, default=Path("sensor.png"))
    arguments = parser.parse_args()
    missed: list[str] = []
    if arguments.part != "speed":
        curves = {signal.name: print_errors(signal) for signal in (ramps(), sinusoids(), fades(), edges())}
        curves["edges, pauses and bursts"], missed = print_pauses()
        draw(curves, arguments.plot)
    if arguments.part != "error":
        missed += print_speeds(arguments.frames, arguments.rounds)
    print("\nTargets missed: " + ("; ".join(missed) or "none"))


# Signals with crossings in closed form -------------------------------------------------------------------------------


def ramps() -> Signal:
    """Log intensity rises or falls evenly."""
    # None of them ends on a crossing.
    rates = 0.2 * (np.rint(np.concatenate([np.linspace(-30, -5, PIXELS // 2), np.linspace(5, 30, PIXELS // 2)])) + 0.5)
    first = np.where(rates > 0, -6.0, 0.0)
    return Signal(
        "ramps",
        lambda t_s: np.exp(first + rates * t_s)[None],
        lambda k: [
            1e6 * n * IDEAL.threshold / abs(rates[k]) for n in range(1, math.floor(abs(rates[k]) / IDEAL.threshold) + 1)
        ],
    )


def sinusoids() -> Signal:
    """Log intensity swings by 1.1 at 1 to 8 Hz, from its middle."""
    frequencies, swing = np.linspace(1.05, 7.95, PIXELS), 1.1

    def crossings(k: int) -> list[float]:
        omega, theta, found = 2 * math.pi * frequencies[k], IDEAL.threshold, []
        level, turn = 0.0, 0
        while True:
            # From one turning point to the next: up, down, and so on.
            up = turn % 2 == 0
            while abs(level + (theta if up else -theta)) < swing:
                level += theta if up else -theta
                phase = math.pi * turn + (1 if up else -1) * math.asin(level / swing)
                if phase / omega * 1e6 > STOP_US:
                    return found
                found.append(phase / omega * 1e6)
            turn += 1
            if math.pi * (turn - 0.5) / omega * 1e6 > STOP_US:
                return found

    return Signal("sinusoids", lambda t_s: np.exp(swing * np.sin(2 * np.pi * frequencies * t_s) - 2)[None], crossings)


def fades() -> Signal:
    """Light goes out towards a dark level, as a lamp or a phosphor does."""
    lags_s = np.geomspace(0.02, 0.5, PIXELS)
    bright, dark = 1.0, 0.05

    def crossings(k: int) -> list[float]:
        levels = [math.exp(-n * IDEAL.threshold) for n in range(1, 15)]
        times = [-1e6 * lags_s[k] * math.log((level - dark) / (bright - dark)) for level in levels]
        return [time_us for time_us in times if time_us <= STOP_US]

    return Signal("fades", lambda t_s: (dark + (bright - dark) * np.exp(-t_s / lags_s))[None], crossings)


def edges() -> Signal:
    """A bright edge passes at 40 px/s over pixels that average over their area."""
    return passing_edge("edges", np.array([0.0, 1.0]), np.array([0.0, 40.0]))


def passing_edge(name: str, knots_s: np.ndarray, places_px: np.ndarray) -> Signal:
    """An edge that is at these places at these times and goes evenly in between, only to the right."""
    dark, bright = 0.1, 0.8

    def crossings(k: int) -> list[float]:
        count = math.floor(math.log(bright / dark) / IDEAL.threshold)
        shares = [(dark * math.exp(n * IDEAL.threshold) - dark) / (bright - dark) for n in range(1, count + 1)]
        # Where it stands still the place has no single time; it is never on a crossing there.
        moves = np.concatenate([[True], np.diff(places_px) > 0])
        return [
            1e6 * float(np.interp(k + share, places_px[moves], knots_s[moves]))
            for share in shares
            if k + share <= places_px[-1]
        ]

    def speed_bound(begin_s: float, end_s: float) -> float:
        speeds = np.diff(places_px) / np.diff(knots_s)
        return float(speeds[(knots_s[1:] > begin_s) & (knots_s[:-1] < end_s)].max())

    def intensity(t_s: float) -> np.ndarray:
        place = np.interp(t_s, knots_s, places_px)
        return dark + (bright - dark) * np.clip(place - np.arange(PIXELS), 0.0, 1.0)[None]

    return Signal(name, intensity, crossings, speed_bound)


# Error against cost ---------------------------------------------------------------------------------------------------

Curve = list[tuple[int, float]]
"""Frames, and the mean error of event times in us."""


def print_errors(signal: Signal) -> dict[str, Curve]:
    """One signal; returns its curves."""
    curves: dict[str, Curve] = {"fixed step": [], "v2e": [], "by pictures": [], "by speed": []}
    print(f"\n{signal.name}: frames, mean and largest error of event times in us, events that are missing or too many")
    for step_us in STEPS_US:
        for name, events in (("fixed step", fixed(signal, step_us)), ("v2e", fixed_v2e(signal, step_us))):
            report(curves[name], f"{name} {step_us:,} us", STOP_US // step_us + 1, events, signal)
    for tolerance in (0.2, 0.05, 0.0125, 0.003):
        options = RenderingOptions(tolerance=tolerance, min_interval_us=5, max_interval_us=200_000)
        events, times = adaptive(signal, options, None)
        report(curves["by pictures"], f"pictures, tolerance {tolerance:g}", len(times), events, signal)
    if signal.speed_bound:
        for displacement in (1.0, 0.5, 0.25, 0.125, 0.0625, 0.03125):
            options = RenderingOptions(max_displacement_px=displacement, min_interval_us=5, max_interval_us=200_000)
            events, times = adaptive(signal, options, signal.speed_bound)
            report(curves["by speed"], f"speed, {displacement:g} px", len(times), events, signal)
    return curves


def print_pauses() -> tuple[dict[str, Curve], list[str]]:
    """The scene with pauses and bursts: how many frames fixed steps need for the same error."""
    knots_s = np.array([0.0, 0.25, 0.2625, 0.5, 0.52, 0.9, 1.0])
    places_px = np.array([0.0, 0.01, 20.01, 20.02, 36.02, 36.03, 40.03])
    signal = passing_edge("edges, pauses and bursts", knots_s, places_px)
    curves = print_errors(signal)
    missed = []
    print("  frames that fixed steps need for the same mean error:")
    frames, errors = np.array(curves["fixed step"]).T
    for name in ("by speed", "by pictures"):
        ratios = []
        for num_frames, error in curves[name]:
            if errors.min() <= error <= errors.max():
                # Between the measured steps, on the straight line in logarithms.
                needed = np.exp(np.interp(-np.log(error), -np.log(errors), np.log(frames)))
                ratios.append(needed / num_frames)
                print(
                    f"    {name:12} {num_frames:6,} frames, {error:8.2f} us: fixed {needed:8,.0f}, {ratios[-1]:5.1f} x"
                )
        worst = min(ratios, default=0.0)
        verdict = "met" if worst >= FRAMES_WANTED else "missed"
        print(f"  {name}: at least {worst:.1f} x fewer frames, wanted {FRAMES_WANTED:g} x: {verdict}")
        if worst < FRAMES_WANTED:
            missed.append(f"{name}: {worst:.1f} x fewer frames, wanted {FRAMES_WANTED:g} x")
    return curves, missed


def fixed(signal: Signal, step_us: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixel and time of each event."""
    t_us = np.arange(0, STOP_US + 1, step_us)
    frames = np.stack([signal.intensity(1e-6 * time_us) for time_us in t_us])
    events = simulate_events(frames, t_us, IDEAL, sensor_seed=0, seed=0)
    return events.x, events.t


def fixed_v2e(signal: Signal, step_us: int) -> tuple[np.ndarray, np.ndarray]:
    """The same of the reference."""
    t_us = np.arange(0, STOP_US + 1, step_us)
    frames = np.stack([signal.intensity(1e-6 * time_us) for time_us in t_us])
    maps = sample_pixel_maps((PIXELS, 1), IDEAL, 0)
    rows = simulate_v2e(frames, t_us, IDEAL, maps, np.random.default_rng(0))
    return rows[:, 1].astype(int), 1e6 * rows[:, 0]


def adaptive(signal: Signal, options: RenderingOptions, speed_bound) -> tuple[tuple, np.ndarray]:
    """Pixel and time of each event, and the times of frames."""
    events, times = simulate_rendered(
        signal.intensity, 0, STOP_US, IDEAL, options, sensor_seed=0, seed=0, speed_bound=speed_bound
    )
    return (events.x, events.t), times


def report(curve: Curve, label: str, num_frames: int, events: tuple, signal: Signal) -> None:
    """Print one line and add it to the curve. The k-th event of a pixel is compared with its k-th crossing."""
    x, t = events
    errors, wrong = [], 0
    for k in range(PIXELS):
        true, mine = np.array(signal.crossings(k)), np.sort(t[x == k])
        shared = min(len(true), len(mine))
        errors.append(np.abs(mine[:shared] - true[:shared]))
        wrong += abs(len(true) - len(mine))
    every = np.concatenate(errors)
    print(f"  {label:28} {num_frames:7,} {every.mean():10.2f} {every.max():10.2f} {wrong:5}")
    curve.append((num_frames, float(every.mean())))


def draw(curves: dict[str, dict[str, Curve]], path: Path) -> None:
    """Error against frames, one panel a signal."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(curves), figsize=(4 * len(curves), 3.6), sharey=True, layout="constrained")
    for axis, (name, of_signal) in zip(axes, curves.items(), strict=True):
        for label, curve in of_signal.items():
            if curve:
                frames, errors = zip(*sorted(curve), strict=True)
                axis.loglog(frames, np.maximum(errors, 0.1), "o-", ms=3, label=label)
        axis.set_title(name)
        axis.set_xlabel("frames rendered for a second")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("mean error of event times (us);\n0.25 is the rounding to whole us")
    axes[-1].legend()
    figure.savefig(path, dpi=120)
    print(f"\nplot: {path}")


# Speed ----------------------------------------------------------------------------------------------------------------


def print_speeds(num_frames: int, rounds: int) -> list[str]:
    """Frames and events a CPU second in three scenes, with and without low-pass."""
    import cv2

    missed = []
    rng = np.random.default_rng(0)
    wall = 0.3 * np.exp(8.0 * cv2.GaussianBlur(rng.normal(size=(260, 346 + num_frames)), (0, 0), 3.0))
    wall = np.clip(wall, 0.01, 1.0).astype(np.float32)
    t_us = 4000 * np.arange(num_frames)
    real = SensorOptions(
        threshold_sigma=0.03, refractory_us=500, leak_rate_hz=0.1, shot_noise_rate_hz=1.0, starts_settled=False
    )
    lagging = real.model_copy(update={"cutoff_dark_hz": 22.0, "cutoff_bright_hz": 300.0})
    print(f"\nspeed, 346 x 260 px, {num_frames} frames 4 ms apart: CPU time, medians of {rounds} rounds")
    print(
        f"  {'scene, sensor':38} {'ms/frame':>9} {'frames/s':>9} {'Mev/s':>7} {'v2e ms':>8} {'Mev/s':>7} {'ratio':>7}"
    )
    for scene, height, width in (("all moves", 260, 346), ("a person moves", 200, 90), ("a hand moves", 50, 40)):
        frames = np.repeat(wall[None, :, :346], num_frames, axis=0)
        for frame in range(num_frames):
            frames[frame, 30 : 30 + height, :width] = wall[30 : 30 + height, frame : frame + width]
        for kind, options in (("", real), (", low-pass", lagging)):
            maps = sample_pixel_maps((346, 260), options, 0)
            ours, reference = [], []
            for _ in range(rounds):
                sensor = Sensor((346, 260), options, sensor_seed=0, seed=0)
                start = time.process_time()
                events = sensor.push(frames, t_us)
                ours.append((time.process_time() - start) / num_frames)
                start = time.process_time()
                rows = simulate_v2e(frames, t_us, options, maps, np.random.default_rng(0))
                reference.append((time.process_time() - start) / num_frames)
            mine, its = statistics.median(ours), statistics.median(reference)
            rates = [len(found) / num_frames / 1e6 / seconds for found, seconds in ((events, mine), (rows, its))]
            print(
                f"  {scene + kind:38} {1e3 * mine:9.2f} {1 / mine:9.0f} {rates[0]:7.2f} {1e3 * its:8.2f} "
                f"{rates[1]:7.2f} {its / mine:6.1f}x  {'met' if its >= SPEED_WANTED * mine else 'missed'}"
            )
            if its < SPEED_WANTED * mine:
                missed.append(f"{scene}{kind}: {its / mine:.1f} x v2e's speed, wanted {SPEED_WANTED:g} x")
            if (scene, kind) == ("all moves", ", low-pass"):
                rate, ratio = REAL_TIME_WANTED
                told = f"{1 / mine:.0f} frames a second, wanted {rate:g}, at {its / mine:.1f} x v2e, wanted {ratio:g} x"
                is_met = 1 / mine >= rate and its >= ratio * mine
                print(f"  real time: {told}: {'met' if is_met else 'missed'}")
                if not is_met:
                    missed.append(told)
    return missed


def simulate_v2e(
    frames: np.ndarray, t_us: np.ndarray, options: SensorOptions, maps: PixelMaps, rng: np.random.Generator
) -> np.ndarray:
    """The reference: [N, 4] of time in s, x, y, polarity; intensity [T, H, W] with white = 1."""
    base = lagged = _lin_log(frames[0], options)
    last_s = np.full(base.shape, -np.inf)
    found = []
    for frame, begin_s, end_s in zip(frames[1:], 1e-6 * t_us[:-1], 1e-6 * t_us[1:], strict=True):
        span_s = end_s - begin_s
        response = _lin_log(frame, options)
        if options.cutoff_dark_hz is None:
            lagged = response
        else:
            cutoff_hz = options.cutoff_dark_hz + (options.cutoff_bright_hz - options.cutoff_dark_hz) * frame
            share = np.minimum(2 * np.pi * cutoff_hz * span_s, 1.0)
            lagged = (1 - share) * lagged + share * response
        base = base - maps.leak * span_s
        difference = lagged - base
        num_on = np.maximum(difference, 0.0) // maps.threshold_on
        num_off = np.maximum(-difference, 0.0) // maps.threshold_off
        steps = int(max(num_on.max(), num_off.max(), 1))
        noise = 0.5 * maps.shot_noise_rate_hz * span_s / steps * ((options.shot_noise_rate_bright - 1.0) * frame + 1.0)
        sent_on, sent_off = np.zeros(base.shape), np.zeros(base.shape)
        for step in range(steps):
            time_s = begin_s + span_s * (step + 1) / steps
            on, off = num_on > step, num_off > step
            if options.shot_noise_rate_hz > 0:
                dice = rng.random(base.shape, dtype=np.float32)
                on |= dice > 1.0 - noise * (options.threshold / maps.threshold_on)
                off |= dice < noise * (options.threshold / maps.threshold_off)
            if options.refractory_us > 0:
                ready = time_s - last_s > 1e-6 * options.refractory_us
                on &= ready
                off &= ready
                last_s[on | off] = time_s
            sent_on += on
            sent_off += off
            for mask, polarity in ((on, 1.0), (off, 0.0)):
                y, x = np.nonzero(mask)
                rows = np.empty((len(x), 4))
                rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3] = time_s, x, y, polarity
                found.append(rows)
        base = base + sent_on * maps.threshold_on - sent_off * maps.threshold_off
    return np.concatenate(found)


def _lin_log(intensity: np.ndarray, options: SensorOptions) -> np.ndarray:
    """Log, and below the floor a line to zero that meets it there."""
    light = intensity.astype(np.float64)
    floor = options.log_floor
    return np.where(light > floor, np.log(np.maximum(light, floor)), np.log(floor) - 1.0 + light / floor)


if __name__ == "__main__":
    main()
