"""Light, low-pass and random numbers of one DVS pixel, compiled.

Logarithm and exponential are worked out here, because the library's do one number at a time, and a loop over these
several.
"""

from __future__ import annotations

import math

import numba
import numpy as np

HALF_ROOT_BITS = 0x3FE6A09E667F3BCD
"""sqrt(1 / 2) in IEEE 754 double precision."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_response(light, log_floor):
    """Log above the floor, its tangent below: finite at zero, without a kink.

    The logarithm is worked out here, to an ulp or two, because the library's does one number at a time, and a loop
    over this one takes several: log(2^k m) = k log(2) + 2 artanh((m - 1) / (m + 1)) with m in [0.71, 1.41].
    """
    above = np.float64(max(light, log_floor))
    bits = np.int64(above.view(np.int64))
    exponent = (bits - HALF_ROOT_BITS) >> 52
    mantissa = np.int64(bits - (exponent << 52)).view(np.float64)
    z = (mantissa - 1.0) / (mantissa + 1.0)
    w = z * z
    series = 1 / 19 + w * (1 / 21 + w * (1 / 23))
    series = 1 / 13 + w * (1 / 15 + w * (1 / 17 + w * series))
    series = 1 / 7 + w * (1 / 9 + w * (1 / 11 + w * series))
    series = w * (1 / 3 + w * (1 / 5 + w * series))
    return exponent * math.log(2.0) + (2.0 * z + 2.0 * z * series) + min(light - log_floor, 0.0) / log_floor


@numba.njit(cache=True, nogil=True, error_model="numpy")
def time_constant_us(light, physics):
    """Time constant of the photoreceptor under this light; 0 = there is no low-pass."""
    if physics.cutoff_dark_hz <= 0.0:
        return 0.0
    cutoff_hz = physics.cutoff_dark_hz + (physics.cutoff_bright_hz - physics.cutoff_dark_hz) * min(light, 1.0)
    return 1e6 / (2.0 * math.pi * cutoff_hz)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def shot_noise_rate(light, shot, physics):
    """Shot noise events a us under this light."""
    return shot * (1.0 - (1.0 - physics.shot_noise_rate_bright) * min(light, 1.0))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def one_minus_exp(x):
    """1 - exp(-x) of x >= 0, to an ulp or two; several at once, where the library's takes one number at a time.

    exp(-x) = 2^-k exp(r) with |r| <= log(2) / 2, and exp(r) - 1 by its series.
    """
    x = np.float64(min(x, 64.0))
    shifted = np.float64(x * 1.4426950408889634 + 6755399441055744.0)
    k = shifted - 6755399441055744.0
    r = (k * 0.6931471803691238 - x) + k * 1.9082149292705877e-10
    r2 = r * r
    r4 = r2 * r2
    low = 1.0 / 2 + r * (1.0 / 6) + r2 * (1.0 / 24 + r * (1.0 / 120))
    middle = 1.0 / 720 + r * (1.0 / 5040) + r2 * (1.0 / 40320 + r * (1.0 / 362880))
    high = 1.0 / 3628800 + r * (1.0 / 39916800) + r2 * (1.0 / 479001600 + r * (1.0 / 6227020800))
    series = r + r2 * (low + r4 * (middle + r4 * high))
    power = np.int64((np.int64(1023) << 52) - (shifted.view(np.int64) << 52)).view(np.float64)
    return (1.0 - power) - power * series


@numba.njit(cache=True, nogil=True, error_model="numpy")
def mix(value):
    """The finaliser of splitmix64: every bit of the result depends on every bit of the value."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def draw_uniform(random):
    """The next state of a generator, and a number in [0, 1)."""
    random = random + np.uint64(0x9E3779B97F4A7C15)
    return random, (mix(random) >> np.uint64(11)) * (1.0 / (1 << 53))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def draw_exponential(random):
    """The next state of a generator, and a number of the exponential distribution of mean 1."""
    random, uniform = draw_uniform(random)
    return random, -math.log1p(-uniform)
