"""Event streams from counts: the counts come back, and times are spread as in the windows they were learnt from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import kstest, spearmanr

from ctlev_core import plugins
from ctlev_core.events import files as event_files
from ctlev_core.events.windows import cut
from ctlev_core.postprocessing.event_streams import Spread, TimeModel, fit_times, sample_duration_us, sample_streams
from ctlev_core.realism.distances import estimate_distances, estimate_floor
from ctlev_core.realism.summary import summarise_events
from data_contracts.config import Windows
from data_contracts.errors import DataError
from data_contracts.events import Events, check_events

ENCODING = plugins.load("encodings", "event_histogram")
SPREADS: tuple[Spread, ...] = ("uniform", "paced", "field")


def random_window(seed: int, num_events: int = 800, duration_us: int = 20_000, size=(24, 16)) -> Events:
    """Independent events anywhere."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, duration_us, num_events))
    t[0], t[-1] = 0, duration_us
    x, y = rng.integers(0, size[0], num_events), rng.integers(0, size[1], num_events)
    p = rng.integers(0, 2, num_events)
    return Events(t + 5_000, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8), size)


MODEL = fit_times([random_window(seed) for seed in range(8)])


def encode(events: Events, polarity: bool) -> np.ndarray:
    return ENCODING.encode(events, np.array([[0, len(events)]]), ENCODING.Options(polarity=polarity))[0]


@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 10_000),
    shape=st.tuples(st.integers(1, 3), st.integers(1, 2), st.integers(1, 12), st.integers(1, 12)),
    largest=st.integers(0, 60),
    spread=st.sampled_from(SPREADS),
)
def test_encoding_a_stream_gives_its_counts_again(seed, shape, largest, spread):
    counts = np.random.default_rng(seed).integers(0, largest + 1, shape).astype(np.uint16)
    for row, events in zip(counts, sample_streams(counts, MODEL, seeds=range(len(counts)), spread=spread), strict=True):
        check_events(events, "stream")
        np.testing.assert_array_equal(encode(events, shape[1] == 2), row)
        assert shape[1] == 2 or events.p.all()
        if len(events):
            assert events.t[0] >= 0 and events.t[-1] <= MODEL.durations_us.max()


@pytest.mark.parametrize("spread", SPREADS)
def test_rows_do_not_depend_on_one_another(spread):
    counts = np.random.default_rng(0).poisson(1.0, (4, 2, 10, 14)).astype(np.uint16)
    together = list(sample_streams(counts, MODEL, seeds=[5, 6, 7, 8], spread=spread))
    backwards = list(sample_streams(counts[::-1], MODEL, seeds=[8, 7, 6, 5], spread=spread))[::-1]
    for row in range(4):
        (alone,) = sample_streams(counts[row : row + 1], MODEL, seeds=[5 + row], spread=spread)
        for other in (backwards[row], alone):
            for column in "txyp":
                np.testing.assert_array_equal(getattr(together[row], column), getattr(other, column))
    (other,) = sample_streams(counts[:1], MODEL, seeds=[99], spread=spread)
    assert (other.t != together[0].t).any()


def test_independent_events_are_recognised_and_made_again():
    """Then gaps are those of random times, starts of neighbours say nothing, and polarities are in random order."""
    assert MODEL.scatter > 0.9 and MODEL.keep_polarity < 0.05
    counts = np.full((1, 2, 60, 80), 1, np.uint16)
    for spread in SPREADS:
        (events,) = sample_streams(counts, MODEL, seeds=[1], spread=spread)
        # First and last event of a pixel with two: the smaller and the larger of two uniform variables.
        order = np.argsort(events.y.astype(int) * 80 + events.x, kind="stable")
        gaps = np.diff(events.t[order].reshape(-1, 2), axis=1)[:, 0] / 20_000
        # 4,800 gaps drawn from some 500 recorded ones: a Kolmogorov-Smirnov distance of 0.08 is 1.8 / sqrt(500).
        assert kstest(gaps, lambda gap: 1 - (1 - np.clip(gap, 0, 1)) ** 2).statistic < 0.08
        assert kstest(events.t / 20_000, "uniform").statistic < 0.06
        first_is_positive = events.p[order].reshape(-1, 2)[:, 0].mean()
        assert first_is_positive == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(4800))


@pytest.mark.parametrize(("length_px", "scatter"), [(2.0, 0.3), (6.0, 0.1), (4.0, 0.7)])
def test_a_field_is_recovered_from_its_own_streams(length_px, scatter):
    model = replace(MODEL, length_px=length_px, scatter=scatter)
    counts = np.zeros((6, 1, 120, 160), np.uint16)
    counts[np.random.default_rng(0).random(counts.shape) < 0.7] = 1
    fitted = fit_times(sample_streams(counts, model, seeds=range(6)))
    assert fitted.length_px == pytest.approx(length_px, rel=0.15)
    assert fitted.scatter == pytest.approx(scatter, abs=0.06)


def test_starts_have_the_rank_correlation_of_the_formula():
    model = replace(MODEL, length_px=3.0, scatter=0.2, durations_us=np.array([10**6] * 8))
    counts = np.ones((20, 1, 100, 100), np.uint16)
    starts = np.zeros((20, 100, 100))
    for row, events in enumerate(sample_streams(counts, model, seeds=range(20))):
        starts[row, events.y, events.x] = events.t
    assert kstest(starts[:, ::25, ::25].reshape(-1) / 1e6, "uniform").pvalue > 1e-4
    for lag in (1, 3, 6):
        expected = 6 / np.pi * np.arcsin(0.8 * np.exp(-(lag**2) / 36) / 2)
        found = spearmanr(starts[:, :, lag:].reshape(-1), starts[:, :, :-lag].reshape(-1))[0]
        # A field of 100 x 100 px with this length has some 500 independent places, 20 of them 10,000.
        assert found == pytest.approx(expected, abs=0.04), lag


def test_a_pixel_keeps_its_polarity_as_often_as_real_ones():
    def blocks(seed):
        """Every pixel: three positive events, then three negative ones."""
        rng = np.random.default_rng(seed)
        x, y = np.meshgrid(np.arange(20), np.arange(10))
        t = np.sort(rng.integers(1, 5_000, (200, 6)), axis=1).reshape(-1)
        t[:2] = 0, 5_000
        order = np.argsort(t, kind="stable")
        x, y = (np.repeat(part.reshape(-1), 6)[order].astype(np.uint16) for part in (x, y))
        p = np.tile([1, 1, 1, 0, 0, 0], 200)[order].astype(np.uint8)
        return Events(t[order], x, y, p, (20, 10))

    model = fit_times([blocks(seed) for seed in range(3)])
    # All but the pixel of each window whose second event was moved to the end of it.
    assert model.keep_polarity == pytest.approx(1.0, abs=0.01)
    counts = np.full((1, 2, 50, 50), 3, np.uint16)
    (events,) = sample_streams(counts, model, seeds=[0])
    order = np.argsort(events.y.astype(int) * 50 + events.x, kind="stable")
    changes = (np.diff(events.p[order].reshape(-1, 6).astype(int), axis=1) != 0).sum(axis=1).mean()
    assert changes == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("keep_polarity", [0.0, 0.4, 0.8, 1.0])
def test_how_often_polarity_is_kept_is_recovered_from_its_own_streams(keep_polarity):
    """Also where most pixels have one event of each polarity, which change it once in any order."""
    counts = np.random.default_rng(0).poisson(0.6, (6, 2, 120, 160)).astype(np.uint16)
    fitted = fit_times(sample_streams(counts, replace(MODEL, keep_polarity=keep_polarity), seeds=range(6)))
    # 30,000 such choices: a standard error below 0.01.
    assert fitted.keep_polarity == pytest.approx(keep_polarity, abs=0.03)


def test_durations_are_those_of_windows_of_like_size():
    sizes = np.repeat([100, 10_000], 16)
    model = replace(MODEL, num_events=sizes, durations_us=np.arange(32) + np.repeat([1_000, 9_000], 16))
    rng = np.random.default_rng(0)
    small = {sample_duration_us(150, model, rng) for _ in range(400)}
    large = {sample_duration_us(50_000, model, rng) for _ in range(400)}
    assert small == set(range(1_000, 1_016)) and large == set(range(9_016, 9_032))
    assert sample_duration_us(0, model, rng) in small
    # Of windows of one number of events all are alike, and not those that come first.
    equal = replace(model, num_events=np.full(32, 700))
    assert {sample_duration_us(700, equal, rng) for _ in range(600)} == set(model.durations_us.tolist())


def test_windows_without_times_to_learn_from_are_refused():
    still = random_window(0)
    still = replace(still, t=np.zeros_like(still.t))
    with pytest.raises(DataError, match="two events at different times"):
        fit_times([still, still.slice(0, 1), still.slice(0, 0)])
    with pytest.raises(DataError, match="two events at different times"):
        fit_times([])


def test_windows_of_one_event_a_pixel_are_enough():
    x, y = np.meshgrid(np.arange(8), np.arange(6))
    columns = x.reshape(-1).astype(np.uint16), y.reshape(-1).astype(np.uint16), np.ones(48, np.uint8)
    model = fit_times([Events(np.arange(48) * 10, *columns, (8, 6))])
    (events,) = sample_streams(np.full((1, 1, 4, 4), 3, np.uint16), model, seeds=[0])
    assert len(events) == 48 and events.t[-1] <= 470


@pytest.mark.parametrize(
    ("counts", "seeds", "match"),
    [
        (np.zeros((1, 3, 4, 4), np.uint16), [0], "1 or 2"),
        (np.zeros((1, 2, 4, 4), np.int32), [0], "uint16"),
        (np.zeros((2, 2, 4, 4), np.uint16), [0], "one seed a row"),
        (np.zeros((1, 1, 1, 70_000), np.uint16), [0], "65,536"),
    ],
)
def test_wrong_calls_are_refused_before_anything_is_drawn(counts, seeds, match):
    with pytest.raises(ValueError, match=match):
        sample_streams(counts, MODEL, seeds=seeds)


def distances_of(spread: Spread, model: TimeModel, windows: list[Events]) -> dict[str, float]:
    counts = np.repeat(np.stack([encode(window, True) for window in windows]), 4, axis=0)
    streams = sample_streams(counts, model, seeds=range(100, 100 + len(counts)), spread=spread)
    found = estimate_distances([summarise_events(s) for s in streams], [summarise_events(w) for w in windows])
    return {name: found[name].value for name in ("interval_wasserstein_decades", "isolated_share")}


def test_real_gaps_are_closer_to_the_real_person_than_uniform_times(real_recordings):
    """Other windows of the recording; the floor is the distance of halves of the recorded windows from one another."""
    (path,) = (real_recordings / "person").iterdir()
    events = event_files.read_events_file(path)
    windows = [events.slice(*window) for window in cut(events, Windows(num_events=7500)).tolist()]
    model = fit_times(windows[::2])
    uniform, field = (distances_of(spread, model, windows[1::2]) for spread in ("uniform", "field"))
    floor = estimate_floor([summarise_events(window) for window in windows[1::2]])
    assert field["interval_wasserstein_decades"] < 0.25 * uniform["interval_wasserstein_decades"]
    for name, value in field.items():
        assert value < floor[name].value, name
