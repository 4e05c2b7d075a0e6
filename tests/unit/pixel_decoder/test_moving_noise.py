"""Noise that moves with the images of a stretch: along, white in every image, and the same for the same seed."""

import cv2
import numpy as np
import pytest
from pydantic import ValidationError
from scipy.stats import kstest

from ctlev_core.geometry.image_flow import image_flow
from ctlev_core.pixel_decoder.moving_noise import MovingNoise
from ctlev_core.pixel_decoder.options import PixelDecoderOptions

SIDE = 48


def texture(seed=0, side=3 * SIDE):
    picture = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal((side, side)), (0, 0), 2.5)
    return np.clip(60 + 150 * picture, 0, 120).astype(np.uint8)


def shifted(dx, dy, size=(SIDE, SIDE)):
    """What was at (x, y) is at (x + dx, y + dy)."""
    top, left = SIDE - dy, SIDE - dx
    return np.ascontiguousarray(texture()[top : top + size[0], left : left + size[1]])


def normals(noise, planes=2):
    return noise.standard_normal((planes, *noise._cells.shape), np.float32)


@pytest.mark.parametrize("step", [(2, 0), (-1, 3)])
def test_noise_moves_as_the_picture_does(step):
    dx, dy = step
    noise = MovingNoise((SIDE, SIDE), 7)
    first = normals(noise)
    for number in range(1, 5):
        noise.move(shifted(dx * (number - 1), dy * (number - 1)), shifted(dx * number, dy * number))
        found = normals(noise)
        where_it_went = np.roll(first, (dy * number, dx * number), axis=(1, 2))
        inner = slice(16, -16)
        same = (found == where_it_went)[:, inner, inner]
        assert same.mean() > (0.9 if number == 1 else 0.6), (number, same.mean())


def test_motion_of_less_than_a_pixel_adds_up():
    large = cv2.resize(texture(), None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)

    def at(quarters):
        cut = large[4 * SIDE : 8 * SIDE, 4 * SIDE - quarters : 8 * SIDE - quarters]
        return cv2.resize(cut, (SIDE, SIDE), interpolation=cv2.INTER_AREA)

    noise = MovingNoise((SIDE, SIDE), 3)
    first = normals(noise)
    for number in range(1, 5):  # half a pixel each
        noise.move(at(2 * number - 2), at(2 * number))
    same = (normals(noise) == np.roll(first, 2, axis=2))[:, 12:-12, 12:-12]
    assert same.mean() > 0.4


def test_where_nothing_moves_noise_is_drawn_anew():
    noise = MovingNoise((SIDE, SIDE), 1)
    before = normals(noise)
    noise.move(shifted(0, 0), shifted(0, 0))
    after = normals(noise)
    assert (before != after).all() and abs(np.corrcoef(before.ravel(), after.ravel())[0, 1]) < 0.05


def test_noise_stays_white_whatever_the_flow():
    """1.7 times as large: each cell of the canvas would lie under three pixels."""
    noise = MovingNoise((SIDE, SIDE), 5)
    picture = texture()[:SIDE, :SIDE]
    for scale in (1.1, 1.2, 1.3):
        grown = cv2.resize(picture, None, fx=scale, fy=scale)
        start = (len(grown) - SIDE) // 2
        after = np.ascontiguousarray(grown[start : start + SIDE, start : start + SIDE])
        noise.move(picture, after)
        picture = after
    found = normals(noise, planes=40)
    moved = noise._cells[noise._cells >= 0]
    assert len(moved) > 200 and len(np.unique(moved)) == len(moved)
    assert kstest(found.ravel()[::7], "norm").pvalue > 1e-3
    for axis in (1, 2):
        near, far = np.moveaxis(found, axis, 0)[1:], np.moveaxis(found, axis, 0)[:-1]
        assert abs(np.corrcoef(near.ravel(), far.ravel())[0, 1]) < 0.02
    uniform = noise.random((40, SIDE, SIDE), np.float32)
    assert uniform.dtype == np.float32 and kstest(uniform.ravel()[::7].astype(float), "uniform").pvalue > 1e-3


def test_requests_differ_and_seeds_repeat():
    one, same, other = MovingNoise((8, 8), 4), MovingNoise((8, 8), 4), MovingNoise((8, 8), 5)
    first = normals(one)
    np.testing.assert_array_equal(first, normals(same))
    assert (first != normals(one)).all() and (first != normals(other)).all()


def test_flow_of_a_shift_is_the_shift():
    found = image_flow(shifted(0, 0), shifted(3, -2))
    np.testing.assert_allclose(np.median(found.vectors[8:-8, 8:-8], axis=(0, 1)), (3, -2), atol=0.2)
    large = [np.kron(picture, np.ones((3, 3), np.uint8)) for picture in (shifted(0, 0), shifted(3, -2))]
    found = image_flow(*large)
    assert found.factor == 3
    np.testing.assert_allclose(np.median(found.vectors[8:-8, 8:-8], axis=(0, 1)), (3, -2), atol=0.2)


def test_it_needs_a_decoder_that_sees_the_frame_before_and_trains_none_anew():
    with pytest.raises(ValidationError, match="moving_noise needs previous_frame: true"):
        PixelDecoderOptions(moving_noise=True)
    still, moving = (PixelDecoderOptions(previous_frame=True, moving_noise=moves) for moves in (False, True))
    assert moving.of_training == still.of_training != moving
