"""From horizon heights to the log-likelihood of a place: soft edges, and a cap on what one direction may claim."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.types import Array, Evidence, Ints

SECTOR_STEP = 10.0  # between the numbers of neighbouring sectors: more than any two elevations differ


@dataclass(frozen=True)
class Sectors:
    """The evidence sorted into narrow sectors of azimuth, each of which may be wholly wrong (a boulder, a map error).

    With the rays' contributions g_i, a sector contributes log((1 - eps) exp(sum g_i - M) + eps): at worst log eps,
    however many of its stars contradict a place. M is the best that any skyline could reach there, the largest sum of
    l_i above one elevation. (The sum of all positive l_i is no such measure: thousands of faint stars make it so high
    that no skyline comes near it, and every sector would always count as wrong.)
    """

    evidence: Evidence
    sector: Ints  # (n,) of each ray
    ceiling: Array  # (sectors,) M
    epsilon: float

    @classmethod
    def of(cls, evidence: Evidence, width_rad: float, epsilon: float) -> Sectors:
        count = max(1, round(2 * np.pi / width_rad))
        sector = (evidence.azimuth_rad / (2 * np.pi) * count).astype(np.int64) % count
        return cls(evidence, sector, _best_skyline(evidence, sector, count), epsilon)

    @property
    def count(self) -> int:
        return len(self.ceiling)

    def score(self, sums: Array) -> Array:
        """Log-likelihood (n,) of places from the sums of contributions (n, sectors)."""
        return np.asarray(np.sum(self.by_sector(sums), axis=-1))

    def by_sector(self, sums: Array) -> Array:
        """What each sector (n, sectors) adds to it."""
        below = sums - self.ceiling
        if self.epsilon == 0.0:
            return np.asarray(below)
        # Within a narrow sector a real skyline can hardly beat the best level one; bounds must not claim that it does.
        below = np.minimum(below, 0.0)
        return np.asarray(np.log((1.0 - self.epsilon) * np.exp(below) + self.epsilon))


def _best_skyline(evidence: Evidence, sector: Ints, count: int) -> Array:
    """Largest sum (sectors,) of the llr above one elevation, in each sector; at least 0 (nothing visible)."""
    order = sorted_by_sector(evidence, sector)
    below = np.concatenate([[0.0], np.cumsum(evidence.llr[order])])
    ends = np.searchsorted(sector[order], np.arange(count + 1))
    # Above the lowest ray, above the next, ..., above none: all that end at the sector's last ray.
    least = np.minimum.reduceat(below, ends[:-1])
    return np.asarray(below[ends[1:]] - np.minimum(least, below[ends[1:]]))


def sorted_by_sector(evidence: Evidence, sector: Ints) -> Ints:
    """Order (n,) of the rays by sector, and from low to high within one."""
    return np.argsort(SECTOR_STEP * sector + evidence.elevation_rad, kind="stable")


def contribution(llr: Array, elevation_rad: Array, horizon_rad: Array, sigma_rad: Array) -> Array:
    """Log-likelihood ratio of a ray given the horizon: l V with a hard edge, else log(V e^l + 1 - V).

    V = Phi((e - H) / sigma). Rises with V for l > 0 and falls for l < 0, so bounds of H give bounds of it.
    """
    margin = elevation_rad - horizon_rad
    hard = np.where(margin > 0, llr, 0.0)
    soft = sigma_rad > 0
    if not np.any(soft):
        return hard
    from scipy.special import ndtr

    # V e^l + 1 - V = 1 + V (e^l - 1), and with l < 0 the same from the other side, so that no digits are lost.
    z = np.divide(margin, sigma_rad, out=np.zeros_like(margin), where=soft)
    mixed = np.minimum(llr, 0.0) + np.log1p(ndtr(np.where(llr > 0, z, -z)) * np.expm1(np.abs(llr)))
    return np.where(soft, mixed, hard)
