"""Event histogram: what it promises, by hand-made examples and properties."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ctlev_core.encodings.event_histogram import Options, encode, encode_each, map_points, render_image
from data_contracts.errors import DataError
from data_contracts.events import Events


def make_events(rows: list[tuple[int, int, int]], sensor_size: tuple[int, int] = (4, 3)) -> Events:
    """Rows of (x, y, p), one microsecond apart."""
    x, y, p = np.array(rows, np.int64).reshape(-1, 3).T
    return Events(
        np.arange(len(x), dtype=np.int64), x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8), sensor_size
    )


def whole(events: Events) -> np.ndarray:
    return np.array([[0, len(events)]], np.int64)


def test_counts_by_hand():
    events = make_events([(0, 0, 1), (3, 2, 0), (0, 0, 1), (0, 0, 0), (1, 2, 1)])
    counts = encode(events, np.array([[0, 3], [3, 5], [2, 2]]), Options())
    assert counts.shape == (3, 2, 3, 4)
    assert counts.dtype == np.uint16
    expected = np.zeros((3, 2, 3, 4), int)
    expected[0, 0, 0, 0], expected[0, 1, 2, 3] = 2, 1
    expected[1, 1, 0, 0], expected[1, 0, 2, 1] = 1, 1
    assert (counts == expected).all()
    without = encode(events, np.array([[0, 3], [3, 5], [2, 2]]), Options(polarity=False))
    assert (without == expected.sum(axis=1, keepdims=True)).all()


def test_counts_stop_at_65535_and_do_not_wrap():
    events = make_events([(1, 1, 1)] * (2**16 + 1) + [(1, 1, 0)] * 3)
    counts = encode(events, whole(events), Options())
    assert (counts[0, 0, 1, 1], counts[0, 1, 1, 1]) == (65535, 3)
    assert encode(events, whole(events), Options(polarity=False))[0, 0, 1, 1] == 65535
    assert render_image(counts, Options(normalisation="max"))[0, 1, 1].tolist() == [255, 0, 0]


ROWS = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 4), st.integers(0, 1)), max_size=40)
FITS = st.sampled_from(["pad", "crop", "stretch"])
SIZES = st.tuples(st.integers(1, 12), st.integers(1, 12))


@settings(deadline=None)
@given(ROWS)
def test_the_sum_is_the_number_of_events(rows):
    events = make_events(rows, (7, 5))
    assert encode(events, whole(events), Options()).sum() == len(rows)


@settings(deadline=None)
@given(ROWS, SIZES, st.sampled_from(["pad", "stretch"]))
def test_pad_and_stretch_lose_no_event(rows, image_size, fit):
    events = make_events(rows, (7, 5))
    counts = encode(events, whole(events), Options(image_size=image_size, fit=fit, resampling="events"))
    assert counts.shape == (1, 2, image_size[1], image_size[0])
    assert counts.sum() == len(rows)


@settings(deadline=None)
@given(ROWS, SIZES, FITS, st.sampled_from(["area", "events"]))
def test_swapping_the_polarity_exchanges_the_channels(rows, image_size, fit, resampling):
    options = Options(image_size=image_size, fit=fit, resampling=resampling)
    events, swapped = make_events(rows, (7, 5)), make_events([(x, y, 1 - p) for x, y, p in rows], (7, 5))
    counts, exchanged = encode(events, whole(events), options), encode(swapped, whole(swapped), options)
    assert (counts == exchanged[:, ::-1]).all()
    assert (render_image(counts, options) == render_image(exchanged, options)[..., ::-1]).all()


@settings(deadline=None)
@given(ROWS, SIZES, FITS)
def test_events_fall_where_their_points_map_to(rows, image_size, fit):
    options = Options(polarity=False, image_size=image_size, fit=fit, resampling="events")
    events = make_events(rows, (7, 5))
    centres = np.array([(x + 0.5, y + 0.5) for x, y, _ in rows]).reshape(-1, 2)
    mapped = map_points(centres, (7, 5), options)
    # A centre on the border between two pixels belongs to the right one: exact fractions decide, floats may sit below.
    columns, image_rows = np.floor(mapped + 1e-9).astype(int).T
    expected = np.zeros((image_size[1], image_size[0]), int)
    for column, row in zip(columns, image_rows, strict=True):
        if 0 <= column < image_size[0] and 0 <= row < image_size[1]:
            expected[row, column] += 1
    assert (encode(events, whole(events), options)[0, 0] == expected).all()


def test_windows_are_independent_of_one_another():
    rng = np.random.default_rng(0)
    events = make_events(rng.integers(0, (4, 3, 2), (100, 3)).tolist())
    windows = np.array([[0, 40], [40, 90], [10, 100]])
    together = encode(events, windows, Options())
    for row, window in enumerate(windows):
        assert (encode(events, window[None], Options())[0] == together[row]).all()
    images = render_image(together, Options())
    assert (images[1] == render_image(together[1:2], Options())[0]).all()


def test_inputs_are_not_changed():
    events = make_events([(0, 0, 1), (1, 1, 0)])
    for column in (events.t, events.x, events.y, events.p):
        column.flags.writeable = False
    windows = whole(events)
    windows.flags.writeable = False
    counts = encode(events, windows, Options())
    counts.flags.writeable = False
    before = counts.copy()
    render_image(counts, Options())
    assert (counts == before).all()


@pytest.mark.parametrize("window", [[-1, 1], [1, 0], [0, 3]])
def test_a_window_that_is_no_range_of_the_events(window):
    with pytest.raises(ValueError, match=r"window 1 must be a range within 2 events, got \["):
        encode(make_events([(0, 0, 1), (1, 1, 0)]), np.array([[0, 1], window]), Options())


def test_windows_of_another_shape():
    with pytest.raises(ValueError, match=r"windows must be \[N, 2\], got \(3,\)"):
        encode(make_events([]), np.array([0, 1, 2]), Options())


@pytest.mark.parametrize("position", [(4, 0), (0, 3), (65535, 65535)])
def test_an_event_outside_the_sensor(position):
    with pytest.raises(DataError, match=r"event 1 at x = .* lies outside the sensor of 4 x 3 px"):
        encode(make_events([(0, 0, 1), (*position, 1)]), np.array([[0, 2]]), Options())


@pytest.mark.parametrize("sensor_size", [(4, 3), (1, 1)])
def test_no_windows_and_no_events(sensor_size):
    events = make_events([], sensor_size)
    assert encode(events, np.zeros((0, 2), np.int64), Options()).shape == (0, 2, *sensor_size[::-1])
    assert render_image(encode(events, np.zeros((0, 2), np.int64), Options()), Options()).shape[0] == 0


# Fitting one size to another --------------------------------------------------------------------------------


def columns_and_rows(sensor_size, **options) -> tuple[list[int], list[int]]:
    """Image column of each sensor column and image row of each sensor row; -1 = dropped."""
    width, height = sensor_size

    def where(position: tuple[int, int], axis: int) -> int:
        chosen = Options(**options, resampling="events")
        counts = encode(make_events([(*position, 1)], sensor_size), np.array([[0, 1]]), chosen)
        return int(np.argwhere(counts)[0][axis]) if counts.any() else -1

    middle_x, middle_y = width // 2, height // 2
    return [where((x, middle_y), 3) for x in range(width)], [where((middle_x, y), 2) for y in range(height)]


def test_crop_of_the_width_alone_takes_the_middle():
    # As DHP19 trims 346 to 344 columns, in small: one column off on either side, nothing scaled.
    assert columns_and_rows((6, 4), image_size=(4, 4), fit="crop") == ([-1, 0, 1, 2, 3, -1], [0, 1, 2, 3])


def test_pad_centres_the_whole_sensor():
    assert columns_and_rows((4, 2), image_size=(4, 6), fit="pad") == ([0, 1, 2, 3], [2, 3])
    assert columns_and_rows((8, 4), image_size=(4, 4), fit="pad") == ([0, 0, 1, 1, 2, 2, 3, 3], [1, 1, 2, 2])


def test_stretch_scales_each_axis():
    assert columns_and_rows((4, 2), image_size=(2, 4), fit="stretch") == ([0, 0, 1, 1], [1, 3])


def test_the_sensor_as_it_is():
    for fit in ("pad", "crop", "stretch"):
        assert columns_and_rows((5, 3), fit=fit) == (list(range(5)), list(range(3)))


def test_map_points_by_hand():
    options = Options(image_size=(100, 100), fit="pad")
    points = np.array([[[0, 0], [200, 100]], [[100, 50], [np.nan, 50]]], np.float32)
    mapped = map_points(points, (200, 100), options)
    assert mapped.dtype == np.float32
    np.testing.assert_allclose(mapped, [[[0, 25], [100, 75]], [[50, 50], [np.nan, 50]]])
    np.testing.assert_allclose(
        map_points(np.array([0, 0]), (200, 100), Options(image_size=(100, 100), fit="crop")), [-50, 0]
    )
    np.testing.assert_allclose(map_points(points, (200, 100), Options()), points)


@pytest.mark.parametrize("image_size", [(0, 4), (4, -1), (4,)])
def test_an_image_size_without_pixels_is_refused(image_size):
    with pytest.raises(ValueError, match="image_size"):
        Options(image_size=image_size)


# Images ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("normalisation", ["three_sigma", "max", "count"])
@pytest.mark.parametrize("polarity", [True, False])
def test_no_events_are_black(normalisation, polarity):
    options = Options(normalisation=normalisation, polarity=polarity)
    counts = encode(make_events([]), whole(make_events([])), options)
    assert not counts.any()
    image = render_image(counts, options)
    assert image.dtype == np.uint8
    assert image.shape == (1, 3, 4, 3)
    assert not image.any()


@pytest.mark.parametrize("normalisation", ["three_sigma", "max"])
@pytest.mark.parametrize("count", [1, 2, 65535])
def test_an_isolated_pixel_and_equal_pixels_are_at_full_scale(normalisation, count):
    options = Options(normalisation=normalisation)
    counts = np.zeros((2, 2, 3, 4), np.uint16)
    counts[0, 0, 1, 2] = count
    counts[1, 1, 0, :] = count
    images = render_image(counts, options)
    assert images[0, 1, 2].tolist() == [255, 0, 0]
    assert images[0].sum() == 255
    assert (images[1, 0] == [0, 0, 255]).all()
    assert images[1].sum() == 4 * 255


def test_colours():
    counts = np.zeros((1, 2, 1, 4), np.uint16)
    counts[0, :, 0] = [[4, 0, 2, 0], [0, 4, 1, 0]]
    options = Options(normalisation="count", full_scale_count=4)
    assert render_image(counts, options)[0, 0].tolist() == [[255, 0, 0], [0, 0, 255], [127, 0, 63], [0, 0, 0]]
    grey = render_image(
        counts.sum(axis=1, keepdims=True, dtype=np.uint16), options.model_copy(update={"polarity": False})
    )
    assert grey[0, 0].tolist() == [[255] * 3, [255] * 3, [191] * 3, [0] * 3]


def test_count_normalisation_clips():
    counts = np.array([0, 1, 7, 8, 9, 65535], np.uint16).reshape(1, 1, 1, 6)
    image = render_image(counts, Options(polarity=False, normalisation="count", full_scale_count=8))
    assert image[0, 0, :, 0].tolist() == [0, 31, 223, 255, 255, 255]


@settings(max_examples=50, deadline=None)
@given(arrays(np.uint16, (2, 2, 3, 4), elements=st.integers(0, 300)), st.sampled_from(["three_sigma", "max", "count"]))
def test_brightness_grows_with_the_count_and_zero_stays_black(counts, normalisation):
    images = render_image(counts, Options(normalisation=normalisation))
    for window in range(2):
        values = np.stack([images[window, ..., 0], images[window, ..., 2]]).ravel().astype(int)
        order = np.argsort(counts[window].ravel(), kind="stable")
        assert (np.diff(values[order]) >= 0).all()
        assert not values[counts[window].ravel() == 0].any()
    assert not images[..., 1].any()


@pytest.mark.parametrize(
    "counts", [np.zeros((1, 1, 3, 4), np.uint16), np.zeros((2, 3, 4), np.uint16), np.zeros((1, 2, 3, 4), np.int64)]
)
def test_images_of_other_arrays_are_refused(counts):
    with pytest.raises(ValueError, match=r"histogram must be \[N, 2, H, W\] uint16, got"):
        render_image(counts, Options())


# One array for all windows -----------------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(ROWS, st.lists(st.tuples(st.integers(0, 40), st.integers(0, 40)), max_size=6), SIZES, st.booleans())
def test_windows_one_by_one_equal_windows_together(rows, bounds, image_size, as_sensor):
    events = make_events(rows, (7, 5))
    windows = np.array([sorted(min(b, len(rows)) for b in bound) for bound in bounds], np.int64).reshape(-1, 2)
    for polarity in (True, False):
        options = Options(image_size=None if as_sensor else image_size, polarity=polarity, resampling="events")
        one_by_one = [counts.copy() for counts in encode_each(events, windows, options)]
        assert len(one_by_one) == len(windows)
        assert all((a == b).all() for a, b in zip(one_by_one, encode(events, windows, options), strict=True))


def test_windows_one_by_one_are_cleared_in_between_on_a_large_sensor():
    # 100 x 100 cells: a window of 200 events is cleared event by event, one of 300 as a whole.
    rng = np.random.default_rng(1)
    events = make_events(rng.integers(0, (100, 100, 2), (1500, 3)).tolist(), (100, 100))
    windows = np.array([[0, 200], [200, 500], [500, 700], [700, 700], [700, 1500]])
    together = encode(events, windows, Options())
    seen = set()
    for counts, expected in zip(encode_each(events, windows, Options()), together, strict=True):
        assert (counts == expected).all()
        seen.add(id(counts))
    assert len(seen) == 1


def test_windows_one_by_one_refuse_what_encode_refuses():
    with pytest.raises(DataError, match="event 1 at x = 4"):
        list(encode_each(make_events([(0, 0, 1), (4, 0, 1)]), np.array([[0, 2]]), Options()))
    with pytest.raises(ValueError, match="window 0 must be a range within 1 events"):
        list(encode_each(make_events([(0, 0, 1)]), np.array([[0, 2]]), Options()))


# Many events a cell: counted in bytes first ------------------------------------------------------------------------


@pytest.mark.parametrize("num_events", [254, 255, 256, 257, 511, 512, 513, 65534, 65535, 65536, 65537, 2**17 + 3])
def test_counts_around_a_full_byte_and_a_full_cell(num_events):
    events = make_events([(0, 1, 0)] * num_events + [(1, 1, 1)], (2, 2))
    expected = np.zeros((1, 2, 2, 2), int)
    expected[0, 1, 1, 0], expected[0, 0, 1, 1] = min(num_events, 65535), 1
    assert (encode(events, whole(events), Options()) == expected).all()
    windows = np.array([[0, num_events], [0, num_events + 1], [num_events, num_events + 1]])
    assert (encode(events, windows, Options())[1] == expected[0]).all()
    assert (encode(events, windows, Options())[2] == [[[0, 0], [0, 1]], [[0, 0], [0, 0]]]).all()


@pytest.mark.parametrize("position", [(0, 3), (4, 0)])
@pytest.mark.parametrize("row", [0, 255, 256, 700, 999])
@pytest.mark.parametrize("image_size", [None, (3, 3)])
def test_the_first_event_outside_is_named_wherever_it_is(position, row, image_size):
    rows = [(0, 0, 1)] * 1000
    rows[row] = (*position, 1)
    events = make_events(rows)
    windows = np.array([[row + 1, 1000], [0, 1000]])
    with pytest.raises(DataError, match=rf"event {row} at x = {position[0]}, y = {position[1]} px"):
        encode(events, windows, Options(image_size=image_size, fit="stretch", resampling="events"))


def test_events_on_the_last_row_and_column_count():
    events = make_events([(3, 2, 1), (3, 0, 0), (0, 2, 0)])
    counts = encode(events, whole(events), Options())
    assert (counts[0, 0, 2, 3], counts[0, 1, 0, 3], counts[0, 1, 2, 0]) == (1, 1, 1)


def test_an_image_too_large_for_its_cell_numbers_is_refused():
    with pytest.raises(ValueError, match="fewer than 2\\^32 cells"):
        encode(make_events([]), np.zeros((0, 2), np.int64), Options(image_size=(65536, 65536), resampling="events"))
