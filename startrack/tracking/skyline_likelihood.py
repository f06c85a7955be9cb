"""The log-likelihood of a position and of errors that frames share, and how it changes with the horizon."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np

from startrack.frames import R_from_rotvec, turn_azel
from startrack.localization.likelihood import PositionLikelihood
from startrack.localization.local_search import LocalLikelihood
from startrack.localization.sector_likelihood import contributions
from startrack.terrain import Terrain
from startrack.tracking.shared import BIAS, CLOCK, EDGE, ImageErrors, SharedErrors
from startrack.types import Array, Bools, Evidence, Ints

NODES, NARROW_NODES = 5, 3  # traced horizons along each side of the neighbourhood
NARROW_M = 20.0  # half of the side of a neighbourhood in which three do: 1e-6 rad on Shackleton's floor
STEP_SIGMAS = 0.5  # of the horizon's spread, to each side: where the change with the horizon is taken
SHAPE_STEP = 1e-4  # relative
TURN_STEP_RAD = 2e-3  # of the sky, at which the horizon's change with the time is taken: crests are no narrower


@dataclass(frozen=True, eq=False)
class SkylineLikelihood:
    """Of parameters (n, 2 + k): a position [m], and shared errors in units of their prior's standard deviation.

    The evidence is that of m items: single stars near the skyline, and azimuths at which the sky's light shows it.
    """

    whole: PositionLikelihood
    local: LocalLikelihood
    shared: SharedErrors
    image_errors: ImageErrors | None  # of the rows of the sky's light; None: there are none
    centre_m: Array  # (2,)

    @classmethod
    def near(
        cls, evidence: Evidence, terrain: Terrain, shared: SharedErrors, image_errors: ImageErrors | None,
        centre_m: Array, half_m: float, raised_sigmas: float,
    ) -> Self:  # fmt: skip
        """For positions within `half_m` of a centre (2,), and shared errors of so many standard deviations."""
        whole = PositionLikelihood.from_evidence(evidence, terrain)
        leeway = raised_sigmas * shared.reach_rad(evidence)
        across = NARROW_NODES if half_m < NARROW_M else NODES
        return cls(whole, whole.near(centre_m, half_m, leeway, across), shared, image_errors, centre_m)

    @cached_property
    def rows(self) -> Ints:
        """(m,) row of each item in the evidence of `local`."""
        stars = np.arange(len(self.local.evidence))[self.local.stars]
        return stars if self.local.profiles is None else np.concatenate([stars, self.local.profiles.row])

    @property
    def is_sky(self) -> Bools:
        """(m,) whether an item is the sky's light at an azimuth."""
        return np.arange(len(self.rows)) >= len(np.arange(len(self.local.evidence))[self.local.stars])

    @property
    def azimuth_rad(self) -> Array:
        """(m,)."""
        return self.local.evidence.azimuth_rad[self.rows]

    @cached_property
    def map_sigma_rad(self) -> Array:
        """(m,) standard deviation of the horizon from the heights of posts, independent between the items."""
        return np.asarray(self.local.terrain.horizon_sigma_rad(self.centre_m[None], self.azimuth_rad))

    @cached_property
    def rise_rad(self) -> Array:
        """(m, k) rise of the horizon beside each item with a shared error of one standard deviation."""
        terrain, azimuth = self.local.terrain, self.azimuth_rad
        elevation = self.local.evidence.elevation_rad[self.rows]
        columns = []
        for name, sigma in zip(self.shared.names, self.shared.sigma, strict=True):
            if name == BIAS:
                rise = np.ones(len(azimuth))
            elif name == CLOCK:
                rise = _raised_by_clock(terrain, self.centre_m, azimuth, elevation, self.shared.turn_rad_s)
            elif name == EDGE:
                rise = self._raised_by_edge
            else:
                rise = _raised_by_shape(terrain, self.centre_m, azimuth, self.shared.shape_axis(name))
            columns.append(sigma * rise)
        return np.stack(columns, axis=1) if columns else np.zeros((len(azimuth), 0))

    @property
    def _raised_by_edge(self) -> Array:
        """(m,) by one px of the whole skyline in the sky's light."""
        if self.image_errors is None:
            return np.zeros(len(self.rows))
        return np.asarray(self.image_errors.at(self.azimuth_rad)[:, 0] * self.is_sky)

    def horizons(self, parameters: Array) -> Array:
        """(n, m) horizon [rad] beside each item."""
        points = np.ascontiguousarray(parameters[:, :2])
        later = parameters[:, 2:] - self.shared.taken(self.whole.evidence)
        return np.asarray(_horizons(self.local.ground, points, self.azimuth_rad) + later @ self.rise_rad.T)

    def contributions(self, horizon_rad: Array) -> Array:
        """(n, m) of each item to the log-likelihood, where the horizon stands beside it (n, m)."""
        rows = self.local.evidence.take(self.local.stars)
        many = len(rows), len(horizon_rad)
        stars = horizon_rad[:, : many[0]]
        tile = [np.tile(a, many[1]) for a in (rows.llr, rows.extended_nats, rows.elevation_rad)]
        sigma = np.tile(self.local.sigma_rad[self.local.stars], many[1])
        found = contributions(tile[0], tile[1], tile[2], stars.ravel(), sigma).reshape(stars.shape)
        profiles = self.local.profiles
        if profiles is None:
            return np.asarray(found)
        sky = np.zeros((many[1], len(profiles.row)))
        profiles.add_sums(np.ascontiguousarray(horizon_rad[:, many[0] :]), np.arange(len(profiles.row)), sky)
        return np.concatenate([found, sky], axis=1)

    def log_likelihood(self, parameters: Array) -> Array:
        """(n,)."""
        return self.whole.sectors.score(self._sums(self.contributions(self.horizons(parameters))))

    def slopes(self, parameters: Array) -> Array:
        """(n, m) change of the log-likelihood with the horizon [1/rad] beside each item.

        The edge of a single star is a step: the change is taken over a part of the horizon's spread.
        """
        horizon = self.horizons(parameters)
        step = STEP_SIGMAS * np.hypot(horizon.std(axis=0), self.map_sigma_rad)
        rise = self.contributions(horizon + step) - self.contributions(horizon - step)
        below = self._sums(self.contributions(horizon)) - self.whole.sectors.ceiling
        epsilon = self.whole.sectors.epsilon
        right = (1.0 - epsilon) * np.exp(np.minimum(below, 0.0))
        counts = np.where(below < 0.0, right / (right + epsilon), 0.0)
        return np.asarray(counts[:, self._sector] * rise / (2 * step))

    @property
    def _sector(self) -> Ints:
        return self.local.sector[self.rows]

    def _sums(self, parts: Array) -> Array:
        """(n, sectors) sums of the items' contributions (n, m) and of the settled rows'."""
        from scipy.sparse import csr_array

        m, sectors = len(self.rows), self.whole.sectors.count
        into = csr_array((np.ones(m), (np.arange(m), self._sector)), shape=(m, sectors))
        return np.asarray(parts @ into + self.local.settled + self.local.ceiling)


def _horizons(ground: Terrain, points: Array, azimuth_rad: Array) -> Array:
    """(n, m) at points (n, 2) and azimuths (m,), interpolated where the ground is prepared for it."""
    nodes = ground.interpolation(azimuth_rad)
    if nodes is None:
        return ground.horizon_rad(points[:, None], azimuth_rad)
    from startrack.terrain import horizon_kernel

    many, found = len(azimuth_rad), np.empty(len(points) * len(azimuth_rad))
    fill: Any = horizon_kernel.interpolate
    where = nodes.ground, nodes.nodes, nodes.per_height, nodes.middle_up_m, nodes.east_m, nodes.north_m, nodes.half_m
    fill(*where, np.repeat(points, many, axis=0), np.tile(np.arange(many), len(points)), found)
    return found.reshape(len(points), many)


def _raised_by_shape(terrain: Terrain, position_m: Array, azimuth_rad: Array, axis: int) -> Array:
    changed = terrain.reshaped(SHAPE_STEP * np.eye(2)[axis])
    here, there = (ground.horizon_rad(position_m[None], azimuth_rad) for ground in (terrain, changed))
    return np.asarray(there - here) / SHAPE_STEP


def _raised_by_clock(
    terrain: Terrain, position_m: Array, azimuth_rad: Array, elevation_rad: Array, turn_rad_s: Array
) -> Array:
    step_s, raised = TURN_STEP_RAD / float(np.linalg.norm(turn_rad_s)), []
    for later_s in (-step_s, step_s):
        azimuth, elevation = turn_azel(azimuth_rad, elevation_rad, R_from_rotvec(later_s * turn_rad_s))
        raised.append(terrain.horizon_rad(position_m[None], azimuth) - elevation)
    return np.asarray(raised[1] - raised[0]) / (2 * step_s)
