"""Windows joined to a stream: each keeps its events, and a pixel does not fire twice at once where two windows meet."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.postprocessing.event_streams import join_windows
from data_contracts.events import Events

INTERVAL_US, SIZE = 100, (3, 2)


def random_windows(rng, count, num_events):
    windows = []
    for _ in range(count):
        n = int(rng.integers(0, num_events + 1))
        t = np.sort(rng.integers(0, INTERVAL_US, n))
        x, y, p = (rng.integers(0, high, n) for high in (*SIZE, 2))
        windows.append(Events(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8), SIZE))
    return windows


def of_pixel(windows, pixel):
    """(time in the whole stream, number of the window) of each event of a pixel, in order."""
    found = []
    for number, window in enumerate(windows):
        found += [(int(t) + number * INTERVAL_US, number) for t, x, y in zip(window.t, window.x, window.y, strict=True)
                  if (x, y) == pixel]  # fmt: skip
    return found


def put_off(events, least_gap_us):
    """Slowly, event by event: the times that they should have."""
    times, busy = [], False
    for place, (t, number) in enumerate(events):
        if place == 0:
            times.append(t)
            continue
        meets = number != events[place - 1][1]
        too_soon = t < times[-1] + least_gap_us
        busy = too_soon and (meets or busy)
        latest = (number + 1) * INTERVAL_US - 1
        times.append(max(t, min(times[-1] + least_gap_us, latest)) if busy else t)
    return times


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(0, 40), st.integers(0, 60))
def test_windows_keep_their_events(seed, count, num_events, least_gap_us):
    windows = random_windows(np.random.default_rng(seed), count, num_events)
    joined = join_windows(windows, INTERVAL_US, least_gap_us)
    assert (np.diff(joined.t) >= 0).all()
    assert joined.sensor_size == SIZE
    for number, window in enumerate(windows):
        inside = (joined.t >= number * INTERVAL_US) & (joined.t < (number + 1) * INTERVAL_US)
        key = lambda events, rows: sorted(zip(events.x[rows], events.y[rows], events.p[rows], strict=True))  # noqa: E731
        assert key(joined, inside) == key(window, slice(None))
    for pixel in np.ndindex(SIZE):
        own = np.sort(joined.t[(joined.x == pixel[0]) & (joined.y == pixel[1])])
        assert own.tolist() == put_off(of_pixel(windows, pixel), least_gap_us)


def test_a_pixel_that_fires_again_at_once_is_put_off():
    def window(*times):
        t = np.array(times)
        zeros = np.zeros(len(t), np.uint16)
        return Events(t, zeros, zeros, np.ones(len(t), np.uint8), SIZE)

    joined = join_windows([window(95), window(2, 8, 60)], INTERVAL_US, 10)
    assert joined.t.tolist() == [95, 105, 115, 160]
    late = join_windows([window(99), window(0, 0)], INTERVAL_US, 80)
    assert late.t.tolist() == [99, 179, 199], "no event leaves its window"
