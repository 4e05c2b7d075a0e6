"""Images of any size from counts at the size of the sensor: nothing lost, no gaps, labels where they were."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.encodings import event_histogram, time_surface, voxel_grid
from ctlev_core.events import image_grid
from ctlev_core.events.image_drawing import draw_values, fit_levels, full_scales, grey_levels
from ctlev_core.events.image_grid import ImageFit
from ctlev_core.events.image_resampling import average_areas, find_overlaps
from data_contracts.errors import DataError
from data_contracts.events import Events

SIZES = st.tuples(st.integers(1, 40), st.integers(1, 40))
FITS = st.sampled_from(["pad", "crop", "stretch"])
NORMALISATIONS = st.sampled_from(["three_sigma", "max", "count"])


def averaged(levels, fit):
    """[N, h, w] float32: averages of [N, H, W] without rounding."""
    size = levels.shape[:0:-1]
    columns, rows = image_grid.pixel_edges(size, fit)
    width, height = image_grid.image_size(size, fit)
    return average_areas(levels, find_overlaps(columns, width), find_overlaps(rows, height))


def random_counts(seed, shape):
    return np.random.default_rng(seed).poisson(0.4, shape).astype(np.uint16)


@settings(deadline=None)
@given(SIZES, SIZES, st.sampled_from(["pad", "stretch"]), st.integers(0, 2**32 - 1))
def test_the_mean_over_the_sensor_is_kept(sensor, size, how, seed):
    fit = ImageFit(image_size=size, fit=how)
    levels = np.random.default_rng(seed).integers(0, 256, (1, sensor[1], sensor[0]), np.uint8)
    columns, rows = image_grid.pixel_edges(sensor, fit)
    area = (columns[-1] - columns[0]) * (rows[-1] - rows[0])
    assert averaged(levels, fit).sum(dtype=np.float64) / area == pytest.approx(levels.mean(), rel=1e-6)


@settings(deadline=None)
@given(SIZES, SIZES, st.sampled_from(["crop", "stretch"]), NORMALISATIONS, st.integers(1, 300))
def test_equal_counts_leave_no_gaps(sensor, size, how, normalisation, count):
    counts = np.full((1, 2, sensor[1], sensor[0]), count, np.uint16)
    fit = ImageFit(image_size=size, fit=how)
    scale = full_scales(counts, normalisation)
    expected = grey_levels(counts, scale)[0, 0, 0, 0]
    if normalisation != "count" and image_grid.is_reduced(sensor, fit):
        expected = 255
    assert (draw_values(counts, fit, normalisation) == expected).all()


@settings(deadline=None)
@given(SIZES, SIZES)
def test_bars_of_padding_are_black_and_the_rest_has_no_gaps(sensor, size):
    fit = ImageFit(image_size=size, fit="pad")
    columns, rows = image_grid.pixel_edges(sensor, fit)
    levels = fit_levels(np.full((1, 1, sensor[1], sensor[0]), 255, np.uint8), fit, "count")[0, 0]
    starts_x, starts_y = np.arange(size[0]), np.arange(size[1])
    is_inside = ((starts_y >= rows[0]) & (starts_y + 1 <= rows[-1]))[:, None]
    is_inside = is_inside & (starts_x >= columns[0]) & (starts_x + 1 <= columns[-1])
    is_outside = ((starts_y >= rows[-1]) | (starts_y + 1 <= rows[0]))[:, None]
    is_outside = is_outside | (starts_x >= columns[-1]) | (starts_x + 1 <= columns[0])
    assert (levels[is_inside] == 255).all() and not levels[is_outside].any()


@settings(deadline=None)
@given(SIZES, FITS, NORMALISATIONS, st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_an_image_of_the_sensors_size_has_the_levels_of_its_counts(sensor, how, normalisation, channels, seed):
    counts = random_counts(seed, (2, channels, sensor[1], sensor[0]))
    scales = full_scales(counts, normalisation)
    expected = np.minimum(255, np.floor(255.0 * counts / scales[:, None, None, None]))
    for size in (None, sensor):
        np.testing.assert_array_equal(draw_values(counts, ImageFit(image_size=size, fit=how), normalisation), expected)


@settings(deadline=None)
@given(SIZES, SIZES, FITS, st.data())
def test_an_isolated_pixel_lies_where_its_point_maps_to(sensor, size, how, data):
    fit = ImageFit(image_size=size, fit=how)
    column, row = (data.draw(st.integers(0, side - 1)) for side in sensor)
    levels = np.zeros((1, sensor[1], sensor[0]), np.uint8)
    levels[0, row, column] = 255
    image = averaged(levels, fit)[0].astype(np.float64)
    corners = np.array([[column, row], [column + 1, row + 1]], float)
    (left, top), (right, bottom) = image_grid.map_points(corners, sensor, fit)
    if min(left, top) < 0 or right > size[0] or bottom > size[1]:
        return  # a part of it is not in the image
    rows, columns = np.mgrid[: size[1], : size[0]] + 0.5
    found = np.array([(columns * image).sum(), (rows * image).sum()]) / image.sum()
    expected = image_grid.map_points(np.array([column + 0.5, row + 0.5]), sensor, fit)
    assert np.abs(found - expected).max() <= 0.5 + 1e-5
    lit = np.argwhere(image > 0)
    assert (lit.min(axis=0) >= np.floor([top + 1e-9, left + 1e-9])).all()
    assert (lit.max(axis=0) < np.ceil([bottom - 1e-9, right - 1e-9])).all()


def slow_image(counts, options):
    """One window, [C, H, W] counts, by loops over dense matrices: [C, h, w] levels."""
    _, height, width = counts.shape
    total = counts.sum(axis=0)
    active = total[total > 0].astype(float)
    levels = np.minimum(255, np.floor(255.0 * counts / (3 * max(active.std(ddof=1), 0.1 / 255)))).astype(np.uint8)
    columns, rows = image_grid.pixel_edges((width, height), options)
    share = np.zeros((2, max(options.image_size), max(width, height)))
    for axis, (edges, num_new) in enumerate(zip((columns, rows), options.image_size, strict=True)):
        for new in range(num_new):
            for old in range(len(edges) - 1):
                share[axis, new, old] = max(0.0, min(new + 1, edges[old + 1]) - max(new, edges[old]))
    across, down = share[0, : options.image_size[0], :width], share[1, : options.image_size[1], :height]
    averages = np.stack([down @ channel @ across.T for channel in levels.astype(float)])
    if not image_grid.is_reduced((width, height), options):
        return np.rint(averages)
    values = np.rint(256 * averages)
    total = values.sum(axis=0)
    return np.minimum(255, np.floor(255.0 * values / (3 * total[total > 0].std(ddof=1))))


@pytest.mark.parametrize("size", [(16, 16), (31, 20), (64, 64), (100, 64)])
@pytest.mark.parametrize("how", ["pad", "crop", "stretch"])
def test_images_equal_a_slow_reference(size, how):
    options = event_histogram.Options(image_size=size, fit=how)
    counts = random_counts(1, (3, 2, 26, 34))
    images = event_histogram.render_image(counts, options).astype(int)
    for image, window in zip(images, counts, strict=True):
        expected = slow_image(window, options)
        # A fraction that is half in exact arithmetic is rounded either way.
        assert np.abs(image[..., [0, 2]].transpose(2, 0, 1) - expected).max() <= 1
        assert (image[..., [0, 2]].transpose(2, 0, 1) == expected).mean() > 0.999
        assert not image[..., 1].any()


@pytest.mark.parametrize("size", [64, 256, 346, 512])
def test_a_recording_and_the_release_made_of_it_give_one_image(size):
    counts = random_counts(2, (3, 1, 260, 346)) * (np.random.default_rng(3).random((3, 1, 260, 346)) < 0.1)
    counts = counts.astype(np.uint16)
    options = event_histogram.Options(polarity=False, image_size=(size, size) if size != 346 else None)
    released = event_histogram.render_image(counts, event_histogram.Options(polarity=False))[..., 0]
    images = event_histogram.render_image(counts, options)
    np.testing.assert_array_equal(event_histogram.render_levels(released[:, None], options), images)
    assert images.max() == 255


def test_smaller_images_are_as_bright_as_their_sensor_was():
    counts = np.zeros((1, 1, 256, 256), np.uint16)
    counts[0, 0, ::16, ::16] = 3
    fit = ImageFit(image_size=(64, 64))
    assert draw_values(counts, fit, "three_sigma").max() == 255 and draw_values(counts, fit, "max").max() == 255
    assert draw_values(counts, fit, "count", full_scale_count=3).max() == 16, "a sixteenth of 255: counts say what is"


def test_larger_images_have_no_gaps_where_events_put_into_pixels_leave_them():
    grid = np.arange(34 * 34)
    events = Events(
        grid, (grid % 34).astype(np.uint16), (grid // 34).astype(np.uint16), np.ones(34 * 34, np.uint8), (34, 34)
    )
    window = np.array([[0, 34 * 34]])
    for resampling, lit in (("area", 1.0), ("events", (34 / 64) ** 2)):
        options = event_histogram.Options(polarity=False, image_size=(64, 64), resampling=resampling)
        image = event_histogram.render_image(event_histogram.encode(events, window, options), options)
        assert image.shape == (1, 64, 64, 3) and (image > 0).mean() == pytest.approx(lit)


@pytest.mark.parametrize("encoding", [event_histogram, time_surface, voxel_grid])
@pytest.mark.parametrize("size", [(20, 20), (64, 64)])
def test_every_encoding_keeps_the_sensor_and_draws_the_image(encoding, size):
    random = np.random.default_rng(4)
    x, y = random.integers(0, 34, 400).astype(np.uint16), random.integers(0, 30, 400).astype(np.uint16)
    events = Events(np.arange(400), x, y, random.integers(0, 2, 400).astype(np.uint8), (34, 30))
    windows = np.array([[0, 250], [250, 400], [5, 5]])
    own, other = encoding.Options(), encoding.Options(image_size=size, fit="stretch")
    kept = encoding.encode(events, windows, other)
    np.testing.assert_array_equal(kept, encoding.encode(events, windows, own))
    images = encoding.render_image(kept, other)
    assert images.shape == (3, size[1], size[0], 3) and images.dtype == np.uint8
    assert images[:2].max(axis=(1, 2, 3)).min() > 127 and not images[2].any()
    put = encoding.Options(image_size=size, fit="stretch", resampling="events")
    assert encoding.encode(events, windows, put).shape[2:] == (size[1], size[0])


def test_counts_of_other_pixels_than_the_images_are_refused():
    image_grid.check_whole_counts((5, 1, 64, 48), (5, 64, 48, 3), "export")
    with pytest.raises(DataError, match=r"export needs whole counts .* 48 x 64 px, .* 64 x 64 px: .*resampling=events"):
        image_grid.check_whole_counts((5, 1, 64, 48), (5, 64, 64, 3), "export")
