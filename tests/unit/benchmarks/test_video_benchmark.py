"""The benchmark beside v2e compares what it says it does: counted by hand, and on a scene where both must agree."""

import importlib
from pathlib import Path

import numpy as np
import pytest

from ctlev_core.sensor.dvs_pixel import PRESETS
from ctlev_core.video.frames import Frames
from data_contracts.events import Events

BENCHMARKS = Path(__file__).resolve().parents[3] / "benchmarks"


@pytest.fixture(scope="module")
def benchmark():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS))
        yield importlib.import_module("video_beside_v2e")


class Ramp(Frames):
    """Light of 4 x 3 pixels rises by e in a tenth of a second, with a frame each millisecond."""

    def __iter__(self):
        for k in range(101):
            yield 1000 * k, np.full((3, 4), 0.1 * np.exp(k / 100), np.float32)


def events_of(t, x, p):
    return Events(np.array(t), np.array(x, np.uint16), np.zeros(len(t), np.uint16), np.array(p, np.uint8), (4, 3))


def test_the_nearest_event_of_the_same_pixel_and_polarity_counts(benchmark):
    reference = events_of([1000, 2000, 3000, 9000], [0, 1, 1, 3], [1, 1, 0, 0])
    events = events_of([900, 2000, 2500, 9000, 9999], [0, 1, 1, 2, 3], [1, 0, 1, 0, 0])
    # 100 us early; 500 us late; 1,000 us early, for that at 2,000 is OFF; and 999 us late.
    share, median_ms, ratio = benchmark.compare(events, reference, 999)
    assert share == 0.75 and median_ms == pytest.approx((0.5 + 0.999) / 2) and ratio == 1.25


def test_on_a_ramp_all_ways_send_the_same_events_but_for_the_spacing_of_frames(benchmark):
    ours, fade, as_given, drawn = (way(Ramp(), PRESETS["ideal"]) for way in benchmark.WAYS.values())
    assert len(ours) == len(fade) == len(as_given) == len(drawn) == 4 * 12
    for one in (fade, as_given, drawn):
        assert benchmark.compare(one, ours, 1001)[0] == 1
    assert benchmark.compare(fade, ours, 1)[0] == 1 and ours.p.all()
