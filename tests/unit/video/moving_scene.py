"""A scene in closed form that moves at constant speed, so that any frame of it can be had."""

import numpy as np

SPEED_PX_S = (420.0, -150.0)
SIZE = (96, 72)


def light(t_s, size=SIZE, speed=SPEED_PX_S):
    """[H, W] float32: smooth blobs and bars on a textured ground, all moving alike."""
    x, y = np.meshgrid(np.arange(size[0]) - speed[0] * t_s, np.arange(size[1]) - speed[1] * t_s)
    texture = np.sin(0.31 * x + 0.8) * np.sin(0.23 * y) + 0.6 * np.sin(0.12 * x - 0.17 * y + 1.0)
    bars = np.tanh(4 * np.sin(0.09 * x + 0.05 * y))
    return (0.35 + 0.12 * texture + 0.12 * bars).clip(0.02, 1).astype(np.float32)


def frames(rate_hz, duration_s=0.2, **more):
    """Times [T] int64 us and frames [T, H, W]."""
    times = np.rint(np.arange(0, duration_s + 1e-9, 1 / rate_hz) * 1e6).astype(np.int64)
    return times, np.stack([light(t * 1e-6, **more) for t in times])


def share_found(events, reference, within_us):
    """The share of the reference's events that have one of the same pixel and polarity near in time."""

    def keys(one):
        return (one.y.astype(np.int64) * SIZE[0] + one.x) * 2 + one.p

    order = np.lexsort((events.t, keys(events)))
    line = keys(events)[order] * 10**9 + events.t[order]
    asked = keys(reference) * 10**9 + reference.t
    after = np.searchsorted(line, asked)
    gaps = [np.abs(line[np.clip(after + step, 0, len(line) - 1)] - asked) for step in (-1, 0)]
    return float((np.minimum(*gaps) <= within_us).mean())
