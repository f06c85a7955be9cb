"""The shifts of a measured skyline against the predicted one, explained by a small step of the position: least squares.

It decides which directions show the predicted skyline and which show something else, and it gives the step, the effect
of errors that all directions share (attitude, lens), and how the position depends on these.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.types import Array, Bools, Ints

WINDOWS = (1, 2, 4, 8, 16, 32, 60)  # sectors that are tested together
OUTLIER_SIGMAS = 4.0  # of the mean residual of a window
CHANCE_SIGMAS = 4.0  # of the mean square of windows, up to which it is chance
MARGIN = 1  # sectors left out on either side of a window that contradicts the others
MAX_DROPPED = 0.4  # of the information


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """Errors that shift the skyline in all directions together: of the image, and of the terrain."""

    raised_px: Array  # (sectors, k) by one unit of each
    mean: Array  # (k,)
    covariance: Array  # (k, k)
    of_terrain: Bools  # (k,) whether the stars see the skyline shifted too
    clock: int | None = None  # which of them is the error of the clock [s]


@dataclass(frozen=True, eq=False)
class SkylineFit:
    """How a measured skyline (sectors) fits after a small step of the position."""

    used: Bools  # (sectors,)
    px_per_m: Array  # (sectors, 2) how the skyline rises with the position
    step_m: Array  # (2,)
    errors: SharedErrors
    shared: Array  # (k,) their values
    covariance: Array  # (2 + k, 2 + k) of both
    residual_px: Array  # (sectors,)
    chi2: float  # of a used sector, mean
    excess: float  # variance of the residuals beside the stated one; 1 unless it is larger beyond chance

    def raised_px(self, of_terrain: bool) -> Array:
        """(sectors,) how much the shared errors raise the skyline: those `of_terrain`, or else those of the image."""
        which = self.errors.of_terrain == of_terrain
        return np.asarray(self.errors.raised_px[:, which] @ self.shared[which])

    @property
    def shared_covariance(self) -> Array:
        """(k, k)."""
        return self.covariance[2:, 2:]

    @property
    def step_covariance(self) -> Array:
        """(2, 2) of the step where the shared errors are known."""
        return np.asarray(np.linalg.inv(np.linalg.inv(self.covariance)[:2, :2]))

    @property
    def step_by_shared(self) -> Array:
        """(2, k): how the position moves with each of the shared errors."""
        return np.asarray(self.covariance[:2, 2:] @ np.linalg.pinv(self.shared_covariance, hermitian=True))


def fit_skyline(
    shift_px: Array,
    variance_px2: Array,
    px_per_m: Array,
    shared: SharedErrors,
    prior_m: Array,
    prior_m2: Array,
    *,
    min_sectors: int,
) -> SkylineFit | None:
    """The step of the position and the shared errors that explain shifts of the skyline; None where none does.

    Args:
        shift_px: (n,) measured height above the predicted skyline, by sectors around the whole circle.
        variance_px2: (n,) infinite where the sector shows nothing.
        px_per_m: (n, 2) how the skyline rises with the position.
        shared: errors common to the sectors.
        prior_m: (2,) expected step.
        prior_m2: (2, 2) its covariance.
        min_sectors: fewer explain nothing.
    """
    used = np.isfinite(variance_px2)
    weight = np.where(used, 1.0 / np.where(used, variance_px2, 1.0), 0.0)
    whole = weight.sum()
    design = np.concatenate([px_per_m, shared.raised_px], axis=1)
    prior = np.zeros((design.shape[1],) * 2)
    prior[:2, :2] = np.linalg.inv(prior_m2)
    prior[2:, 2:] = np.linalg.inv(shared.covariance)
    expected = np.concatenate([prior_m, shared.mean])
    while True:
        w = np.where(used, weight, 0.0)
        if np.count_nonzero(used) < min_sectors or w.sum() < (1.0 - MAX_DROPPED) * whole:
            return None
        covariance = np.linalg.inv(prior + (design * w[:, None]).T @ design)
        solution = covariance @ (design.T @ (w * shift_px) + prior @ expected)
        residual = shift_px - design @ solution
        window = _worst_window(residual, w)
        if window is None:
            chi2 = float(np.sum(w * np.square(residual)) / np.count_nonzero(used))
            excess = _excess(residual, weight)  # of all: many that contradict make the others doubtful
            return SkylineFit(used, px_per_m, solution[:2], shared, solution[2:], covariance, residual, chi2, excess)
        used = used.copy()
        used[window] = False


def _excess(residual_px: Array, weight: Array) -> float:
    """Mean squared residual of sectors, and of the means of windows, in units of their variance; at least 1.

    Errors that neighbouring sectors share (a rim that is not level, a wavy lens) hardly show in single sectors, but
    in windows. What the position absorbs of them is as large as what remains.
    """
    n, found = len(weight), 1.0
    for width in WINDOWS[:-1]:
        part, information = (_window_sums(a, width) for a in (weight * residual_px, weight))
        z2 = np.square(part)[information > 0] / information[information > 0]
        z2 = np.minimum(z2, OUTLIER_SIGMAS**2)
        if z2.mean() > 1.0 + CHANCE_SIGMAS * np.sqrt(2.0 * width / n):
            found = max(found, float(z2.mean()))
    return found


def _window_sums(values: Array, width: int) -> Array:
    """Sums (n,) of `width` values from each on, around the circle."""
    sums = np.concatenate([[0.0], np.cumsum(np.concatenate([values, values[:width]]))])
    return np.asarray(sums[width : width + len(values)] - sums[: len(values)])


def _worst_window(residual_px: Array, weight: Array) -> Ints | None:
    """The sectors of the window whose mean residual is farthest from zero, if that is too far."""
    n, worst, found = len(weight), OUTLIER_SIGMAS, None
    for width in WINDOWS:
        part, information = (_window_sums(a, width) for a in (weight * residual_px, weight))
        score = np.abs(part) / np.sqrt(np.where(information > 0, information, np.inf))
        top = int(np.argmax(score))
        if score[top] > worst:
            worst, found = float(score[top]), np.arange(top - MARGIN, top + width + MARGIN) % n
    return found
