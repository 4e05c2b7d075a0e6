"""Recordings of `studio` beside a recorded one: every statistic of the same order of magnitude, most of them near.

The recording is of a person's head and shoulders, 0.59 s before a DVXplorer at 320 x 240 px; it is not part of the
repository. The sensor preset was estimated from this very recording, so that hot pixels and noise agree by design.
How large people are in the picture and how light it is was chosen; nothing else was fitted.
"""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml

from ctlev_core import plugins
from ctlev_core.events.files import read_events_file
from ctlev_core.realism.distances import mean_distributions, wasserstein
from ctlev_core.realism.summary import AXES, summarise_events
from ctlev_core.sensor.calibration import calibrate
from ctlev_core.sensor.dvs_pixel import PRESETS
from data_contracts.config import DatasetChoice

PRESET = Path(__file__).resolve().parents[3] / "flows" / "presets" / "studio_person.yaml"
NUM_RECORDINGS = 4
"""One of each motion that is learnt from; 2 to 3 s each."""
FACTOR_OF_MEAN, FACTOR_OF_EACH = 3.0, 10.0
"""Between a statistic of the recording and the mean over studio's, and each of them."""
DISTANCE_DECADES = 0.5
"""Wasserstein distance of rates and intervals; those of studio's own motions differ by 0.1 to 0.4."""
STATISTICS = (
    "event_rate_mev_s", "pixel_rate_hz", "positive_share", "active_pixel_share", "hot_pixel_share", "hot_event_share",
    "isolated_share", "noise_rate_hz", "spread",
)  # fmt: skip


@pytest.fixture
def person(real_recordings):
    """The events of the recording."""
    path = real_recordings / "person" / "tonic_sample.aedat4"
    if not path.is_file():
        pytest.skip("the recording of a person is not beside this checkout")
    return read_events_file(path)


@cache
def summarise_studio(count=NUM_RECORDINGS, **changes):
    """Summaries of the preset's first recordings, with some of its options changed."""
    options = yaml.safe_load(PRESET.read_text())["dataset"]["options"] | changes
    plugin = plugins.load_options(DatasetChoice(name="studio", options=options))
    recordings = plugin.module.list_recordings(plugin.options)[:count]
    return [summarise_events(plugin.module.read_events(recording, plugin.options)) for recording in recordings]


def ratios(summaries, reference):
    """[recordings, statistics], of those of studio to those of the recording."""
    return np.array([[summary.numbers[name] / reference.numbers[name] for name in STATISTICS] for summary in summaries])


@pytest.mark.slow
def test_every_statistic_is_of_the_same_order_of_magnitude(person):
    reference = summarise_events(person)
    assert set(STATISTICS) == set(reference.numbers)
    found = ratios(summarise_studio(), reference)
    for name, column in zip(STATISTICS, found.T, strict=True):
        assert 1 / FACTOR_OF_MEAN < column.mean() < FACTOR_OF_MEAN, f"{name}: {column}"
        assert (column > 1 / FACTOR_OF_EACH).all() and (column < FACTOR_OF_EACH).all(), f"{name}: {column}"


@pytest.mark.parametrize("axis", ["pixel_rate", "interval"])
def test_rates_and_intervals_are_distributed_alike(person, axis):
    ours, real = mean_distributions(summarise_studio())[axis], summarise_events(person).distributions[axis]
    assert wasserstein(ours, real, AXES[axis].width) < DISTANCE_DECADES


def test_an_ideal_sensor_fails(person):
    """What simulators miss: without noise and hot pixels a statistic is off by far more than an order of magnitude."""
    found = ratios(summarise_studio(count=1, sensor_preset="ideal"), summarise_events(person)).mean(axis=0)
    of = dict(zip(STATISTICS, found, strict=True))
    assert of["noise_rate_hz"] < 0.1 and of["isolated_share"] < 0.2 and of["hot_pixel_share"] == 0


def test_the_sensor_preset_is_what_the_recording_tells(person):
    estimated = calibrate(person).options.model_dump()
    preset = PRESETS["dvxplorer"].model_dump()
    measured = (
        "refractory_us",
        "leak_rate_hz",
        "shot_noise_rate_hz",
        "rate_spread",
        "hot_pixel_fraction",
        "hot_rate_hz",
    )
    for name in measured:
        # The preset's numbers are rounded to two figures or three.
        assert preset.pop(name) == pytest.approx(estimated.pop(name), rel=0.01), name
    assert preset == estimated
