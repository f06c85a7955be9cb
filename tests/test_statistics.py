"""Medians beside numpy's, and the spread of normal numbers."""

from __future__ import annotations

import numpy as np
import pytest

from startrack.core.statistics import median, robust_sigma


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int64])
@pytest.mark.parametrize("shape", [(1,), (2,), (7, 8), (8, 7, 5)])
def test_median_is_that_of_numpy(dtype, shape):
    values = np.random.default_rng(3).normal(0.0, 50.0, shape).astype(dtype)
    for axis in (None, *range(len(shape))):
        np.testing.assert_array_equal(median(values, axis), np.median(values, axis=axis))


def test_median_of_nothing_is_not_a_number():
    assert np.isnan(median(np.zeros(0)))
    np.testing.assert_array_equal(median(np.zeros((3, 0)), 1), np.full(3, np.nan))


def test_robust_sigma_of_normal_numbers_with_outliers():
    values = np.random.default_rng(5).normal(7.0, 2.0, (3, 4001))
    values[:, :40] = 1e6
    np.testing.assert_allclose(robust_sigma(values, axis=1), 2.0, rtol=0.06)
    np.testing.assert_allclose(robust_sigma(values[0], 7.0), 2.0, rtol=0.06)
