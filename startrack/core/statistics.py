"""Numbers from functions and samples: spread, weights of log-likelihoods, a root, and values around the horizon."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from startrack.core.values import Array
from startrack.kernels.library import kernel

NORMAL_BY_MEDIAN = 1.4826  # standard deviation of a normal variable over the median of its absolute value
# The normal distribution function as the kernels interpolate it: by so many steps, of so many sigmas to either side; in
# common.h too.
CDF_REACH, CDF_STEPS = 8.0, 4096
NORMAL_CDF = np.array([0.5 * math.erfc(-x / math.sqrt(2.0)) for x in np.linspace(-CDF_REACH, CDF_REACH, CDF_STEPS + 1)])


def median(values: Any, axis: int | None = None) -> Any:
    """The median of `values` (...) that are numbers, along `axis` or (None) of all; nan where there are none.

    Six times as fast as numpy.median, whose partition at two places has no vector instructions.
    """
    values, axis = (np.ravel(values), 0) if axis is None else (np.asarray(values), axis)
    count = values.shape[axis]
    if not count:
        return np.full(np.delete(values.shape, axis), np.nan)[()]
    parts = np.partition(values, count // 2, axis=axis)
    lower, upper, _ = np.split(parts, [count // 2, count // 2 + 1], axis=axis)
    middle = upper if count % 2 else 0.5 * (lower.max(axis=axis, keepdims=True) + upper)
    return middle.squeeze(axis)[()]


def robust_sigma(values: Any, centre: Any = None, axis: int | None = None) -> Any:
    """Standard deviation of normal `values` (...) by the median of their absolute deviations; outliers hardly matter.

    `centre`: from where the deviations count; None: from the median. With `axis` an array, along that axis; else a
    float.
    """
    if centre is None:
        centre = median(values) if axis is None else np.expand_dims(median(values, axis), axis)
    middle = median(np.abs(values - centre), axis)
    return NORMAL_BY_MEDIAN * (float(middle) if axis is None else middle)


def relative_weights(log_weights: Array, axis: int | None = None) -> Array:
    """Exponentials (...) of `log_weights` (...), the largest of them, or of those along `axis`, scaled to 1."""
    return np.asarray(np.exp(log_weights - log_weights.max(axis=axis, keepdims=True)))


def shares(log_weights: Array) -> Array:
    """Exponentials (n,) of `log_weights` (n,), scaled so that their sum is 1."""
    return np.asarray(np.exp(log_weights - np.logaddexp.reduce(log_weights)))


def root_between(function: Callable[[float], float], before: float, now: float, tolerance: float) -> float:
    """A root of a `function` that changes its sign between `before` and `now`, to a `tolerance`.

    Brent 1973, Algorithms for Minimization without Derivatives, chapter 4, step by step as scipy.optimize.brentq, which
    takes 0.1 s to load.
    """
    f_before, f_now = function(before), function(now)
    other = f_other = last_step = step = 0.0
    while True:
        if f_before != 0.0 and (f_before < 0.0) != (f_now < 0.0):
            other, f_other, last_step, step = before, f_before, now - before, now - before
        if abs(f_other) < abs(f_now):
            before, now, other = now, other, now
            f_before, f_now, f_other = f_now, f_other, f_now
        least, half = 0.5 * (tolerance + 4.0 * np.finfo(float).eps * abs(now)), 0.5 * (other - now)
        if f_now == 0.0 or abs(half) < least:
            return now
        tried = math.inf
        if abs(last_step) > least and abs(f_now) < abs(f_before):
            slope = (f_now - f_before) / (now - before)
            if before == other:
                tried = -f_now * (now - before) / (f_now - f_before)
            elif f_other != f_before:
                far = (f_other - f_now) / (other - now)
                tried = -f_now * (f_other * far - f_before * slope) / (far * slope * (f_other - f_before))
        is_useful = 2.0 * abs(tried) < min(abs(last_step), 3.0 * abs(half) - least)
        last_step, step = (step, tried) if is_useful else (half, half)
        before, f_before = now, f_now
        now += step if abs(step) > least else math.copysign(least, half)
        f_now = function(now)


def error_ellipse(covariance: Array) -> tuple[Array, Array, Array]:
    """Larger and smaller semi-axis (...) of one sigma, and azimuth (...) of the larger [rad, from 0 to pi].

    `covariance` (..., 2, 2) is that of east and north.
    """
    squares, axes = np.linalg.eigh(covariance)
    minor, major = np.moveaxis(np.sqrt(np.maximum(squares, 0.0)), -1, 0)
    return major, minor, np.arctan2(axes[..., 0, 1], axes[..., 1, 1]) % np.pi


def interpolate_circle(values: Array, azimuth_rad: Array) -> Array:
    """Linear interpolation at `azimuth_rad` (...) [rad] of `values` (m,), which stand at even steps from azimuth 0."""
    found = np.array(azimuth_rad, dtype=np.float64, order="C")
    _interpolate(np.ascontiguousarray(values, dtype=np.float64), found.reshape(-1))
    return found


_interpolate = kernel("interpolate_circle", "values: float64[m]", "found: out float64[n]")
