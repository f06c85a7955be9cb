"""Catalogue stars beside given directions, and the one-to-one matches of a short list made from them alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np

from startrack.identify.match import (
    BLEND_FLUX_RATIO,
    DEPTH_BELOW_THRESHOLD_MAG,
    MAGNITUDE_TOLERANCE,
    SIGNIFICANT_SNR,
)
from startrack.types import Array, Bools, Ints, Stars

LEVELS = (1000, 4000, 16000)  # brightest stars per tree; the last tree holds them all
NEIGHBOURS = 8  # of a detection; more only in clusters
BLEND_MAG = -2.5 * np.log10(BLEND_FLUX_RATIO)


class NearStars:
    """Trees over the brightest stars (sorted, brightest first), by depth: a short list needs only a shallow one."""

    def __init__(self, stars: Stars) -> None:
        self.stars = stars
        self._trees: dict[int, Any] = {}

    def _tree(self, count: int) -> Any:
        from scipy.spatial import cKDTree

        level = next((level for level in LEVELS if level >= count), len(self.stars))
        if level not in self._trees:
            self._trees[level] = cKDTree(self.stars.rays_icrs[:level])
        return self._trees[level]

    def pairs(self, rays_icrs: Array, radius_rad: float, count: int) -> tuple[Ints, Ints]:
        """(ray, star) of all pairs closer than the radius, of the `count` brightest stars; sorted by ray."""
        tree, chord = self._tree(count), 2 * np.sin(radius_rad / 2)
        k = min(NEIGHBOURS, tree.n)
        star = tree.query(rays_icrs, k, distance_upper_bound=chord)[1]
        if k < tree.n and star[:, -1].min() < tree.n:  # a missing neighbour has number n
            return self._many(tree, rays_icrs, chord, count)
        ray, column = np.nonzero(star < min(count, tree.n))
        return ray, star[ray, column]

    def _many(self, tree: Any, rays_icrs: Array, chord: float, count: int) -> tuple[Ints, Ints]:
        """The same where some ray has many neighbours."""
        found = tree.query_ball_point(rays_icrs, chord)
        ray = np.repeat(np.arange(len(found)), list(map(len, found)))
        star = np.array(list(chain.from_iterable(found)), dtype=np.int64)
        wanted = star < count
        return ray[wanted], star[wanted]


def middle(values: Array) -> float:
    """The upper median: numpy's own costs a tenth of the whole identification."""
    return float(np.sort(values)[len(values) // 2])


def first_of_each(numbers: Ints) -> Ints:
    """Where in `numbers` (n,) each value stands first."""
    order = np.argsort(numbers, kind="stable")
    ordered = numbers[order]
    new = np.ones(len(order), dtype=bool)
    np.not_equal(ordered[1:], ordered[:-1], out=new[1:])
    return order[new]


@dataclass(frozen=True)
class Light:
    """What a list of detections says of brightness, on the catalogue's scale."""

    measured_mag: Array  # (n,) V if the detection is a star
    saturated: Bools  # (n,) then at least as bright as that
    limit_mag: float  # faintest V that might have been detected
    certain_mag: float  # stars brighter than that must have been, if nothing hides them

    @classmethod
    def of(cls, flux_e: Array, saturated: Bools, v_mag: Array, detection: Ints) -> Light:
        """From stars of these magnitudes (k,) that lie on these detections (k,)."""
        brightness = -2.5 * np.log10(np.maximum(flux_e, 1e-9))
        plain = ~saturated[detection]  # a saturated star's flux is a lower bound
        if np.count_nonzero(plain) >= 3:
            v_mag, detection = v_mag[plain], detection[plain]
        measured = brightness + middle(v_mag - brightness[detection])
        faintest = float(measured.max())
        return cls(measured, saturated, faintest + DEPTH_BELOW_THRESHOLD_MAG, faintest)


@dataclass(frozen=True)
class Pairs:
    """Detections and the stars beside them, at one attitude."""

    detection: Ints  # (k,)
    star: Ints  # (k,)
    distance_px: Array  # (k,) infinite for stars outside the frame
    v_mag: Array  # (k,)
    v_sigma_mag: Array  # (k,)
    light: Light

    @cached_property
    def nearest(self) -> Ints:
        """Which pairs are each other's nearest and agree in brightness: at most one per detection and per star."""
        measured = self.light.measured_mag[self.detection]
        seen = np.flatnonzero(np.isfinite(self.distance_px) & (self.v_mag < self.light.limit_mag))
        seen = seen[np.argsort(self.distance_px[seen])]
        seen = seen[first_of_each(self.star[seen])]
        agrees = np.abs(self.v_mag - measured) < np.hypot(MAGNITUDE_TOLERANCE, 2 * self.v_sigma_mag)
        agrees |= self.light.saturated[self.detection] & (self.v_mag < measured)
        seen = seen[agrees[seen]]
        seen = seen[np.argsort(self.distance_px[seen])]
        return seen[first_of_each(self.detection[seen])]

    def alone(self, which: Ints, radius_px: float) -> Bools:
        """Whether no other star of comparable light falls within the radius of the detections of the pairs `which`."""
        close = np.flatnonzero(self.distance_px < radius_px)
        first = np.searchsorted(self.detection[close], self.detection[which])
        last = np.searchsorted(self.detection[close], self.detection[which], side="right")
        alone = np.ones(len(which), dtype=bool)
        own = 1 * (self.distance_px[which] < radius_px)
        for i in np.flatnonzero(last - first > own):
            others = close[first[i] : last[i]]
            comparable = self.v_mag[others] < self.v_mag[which[i]] + BLEND_MAG
            alone[i] = not np.any(comparable & (self.star[others] != self.star[which[i]]))
        return alone

    def unexplained(self, snr: Array, gate_px: float) -> int:
        """Significant detections with no star near that could be a part of their light."""
        significant = snr > SIGNIFICANT_SNR
        if not significant.any():
            return 0
        faintest = self.light.measured_mag[significant].max() + 2.0
        significant[self.detection[(self.distance_px < gate_px) & (self.v_mag < faintest)]] = False
        return int(np.count_nonzero(significant))
