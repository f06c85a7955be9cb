"""Errors that raise the skyline at all azimuths together, of terrain and clock, and the directions that rows show.

Waves of the horizon's error over azimuth are linear at any size, and integrated in closed form: see `linear_errors`.

In standard deviations of their prior, the errors have information by the rows once the position is free. Along a
direction with next to none the errors keep their prior, and the position moves by what leaves the skyline as it is:
a turn or a larger size of a round crater, a tilt of its rim seen from the middle. These are integrated in closed form.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from startrack.core.types import Array, Bools, Clock, Ints
from startrack.frames import R_from_rotvec, turn_sky
from startrack.localization.likelihood.skyline_profiles import SectorMoments
from startrack.terrain import ShapeError, Terrain

LEAST_SIZE = 1e-3  # of a crater, in the stated one: a normal error reaches beyond
SCALE_STEP = 1e-3  # of a crater's size, at which the skyline's change with it is taken
TURN_STEP_RAD = 2e-3  # of the sky, at which the skyline's change with the time is taken: its crests are no narrower
CLOCK_FACT = "time_sigma_s"
OWN_EDGE = "sky_edge"  # no fact: the edge of the sky's light is not the skyline
OWN_EDGE_PROBABILITY = 0.01
RESIDUAL_PART = 1e-3  # of a gross error: the sigma of an error that is zero unless it is gross
NEGLIGIBLE_M = 0.05  # by which an error of the clock moves a row over the search area, without an effect on the fix
LEAST_INFORMATION = 0.03  # beside that of the prior, from which on a direction is sampled: a sigma smaller by 1.5 %


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """The errors (k,) of a terrain and of a clock, in the units that their names end with.

    In ground that is the same after a turn about the vertical, the vertical part of the clock's turn only turns the
    position: there the parameters hold the position before that turn, and before it is scaled with the crater.
    """

    listed: tuple[ShapeError, ...]
    clock: Clock | None = None  # the last of the errors, where it is not None
    waves: tuple[ShapeError, ...] = ()  # (w,) beside the others
    axisymmetric: bool = False

    @classmethod
    def of(cls, terrain: Terrain, clock: Clock | None, doubted: str = "") -> SharedErrors:
        """Shared errors of a `terrain` and a `clock` that may be other than zero.

        What is stated of the fact `doubted` does not count: its errors are gross.
        """
        known = _known_errors(terrain, clock)
        known = [replace(one, gross_probability=1.0) if one.fact == doubted else one for one in known]
        other = [one for one in known if one.sigma > 0.0 or one.gross_probability > 0.0 or one.mean != 0.0]
        listed, waves = (tuple(one for one in other if bool(one.wave) == is_wave) for is_wave in (False, True))
        has_clock = any(one.fact == CLOCK_FACT for one in listed)
        return cls(listed, clock if has_clock else None, waves, terrain.axisymmetric)

    @staticmethod
    def doubtable(terrain: Terrain) -> tuple[str, ...]:
        """Stated facts of a `terrain` whose errors would be larger if the statement were wrong."""
        known = terrain.errors.shape
        return tuple(
            dict.fromkeys(one.fact for one in known if one.gross_probability == 0.0 and one.gross_sigma > one.sigma)
        )

    def __len__(self) -> int:
        return len(self.listed)

    @property
    def every(self) -> tuple[ShapeError, ...]:
        """Listed errors and waves (k + w,)."""
        return (*self.listed, *self.waves)

    @cached_property
    def facts(self) -> tuple[str, ...]:
        """Facts with a gross part."""
        return tuple(dict.fromkeys(error.fact for error in self.every if error.gross_probability > 0.0))

    @property
    def unstated_facts(self) -> tuple[str, ...]:
        """Facts with a gross part that no file states."""
        stated = {one.fact for one in self.every if one.is_stated}
        return tuple(fact for fact in self.facts if fact not in stated)

    def is_of_fact(self, fact: str) -> Bools:
        """Whether errors (k,) are those of a `fact`."""
        return np.array([one.fact == fact for one in self.listed], dtype=bool)

    def are_waves(self, fact: str) -> bool:
        """Whether the errors of a `fact` are the waves."""
        return any(one.fact == fact for one in self.waves)

    def sigma(self, gross: str = "") -> Array:
        """Standard deviations (k,), each in its error's unit; those of the fact `gross` are of a gross error."""
        return _sigma(self.listed, gross)

    def waves_sigma_rad(self, gross: str = "") -> Array:
        """Standard deviations (w,) [rad] of the waves; those of the fact `gross` are of a gross error."""
        return _sigma(self.waves, gross)

    @property
    def offset_s(self) -> float:
        """Time [s] by which the time that the rows are turned to is later than stated."""
        return 0.0 if self.clock is None else self.clock.offset_s

    @cached_property
    def mean(self) -> Array:
        """Expected values (k,): not zero for rows turned to another time, or ground of another shape, than stated."""
        found = np.array([one.mean for one in self.listed])
        found[-1:] -= self.offset_s
        return found

    @property
    def stated_values(self) -> Array:
        """Expected values (k,), with that of the clock as stated, also where another time is expected."""
        found = self.mean.copy()
        if self.clock is not None:
            found[-1] = -self.offset_s
        return found

    def log_probability(self, gross: str = "") -> float:
        """Logarithm of the prior probability that the fact `gross` alone has a gross error; "": that none has."""
        each = {one.fact: one.gross_probability for one in self.every}
        own_edge = np.log(OWN_EDGE_PROBABILITY) if gross == OWN_EDGE else 0.0
        return float(sum(np.log(p if fact == gross else 1.0 - p) for fact, p in each.items()) + own_edge)

    def slopes_rad(
        self, terrain: Terrain, position_m: Array, azimuth_rad: Array, horizon_rad: Array, by_name: dict[str, Array]
    ) -> Array:
        """Rise (k, n) of the skyline `horizon_rad` (n,) at `azimuth_rad` (n,) by one unit of each error.

        The skyline is that of the `terrain` at `position_m` (2,); `by_name` holds the rises (n,) by its shape's errors.
        """
        own = [by_name[one.name] for one in self.listed if one.fact != CLOCK_FACT]
        shape = np.array(own).reshape(len(own), len(azimuth_rad))
        if len(self._scales):
            farther, nearer = (position_m * (1.0 + sign * SCALE_STEP) for sign in (1.0, -1.0))
            horizon = np.asarray(terrain.horizon_rad(np.array([farther, nearer])[:, None], azimuth_rad))
            shape[self._scales] += (horizon[0] - horizon[1]) / (2 * SCALE_STEP)
        if self.clock is None:
            return shape
        turn = self.clock.turn_rad_s.copy()
        if self.axisymmetric:
            turn[2] = 0.0
        size = float(np.linalg.norm(self.clock.turn_rad_s))
        if not np.linalg.norm(turn) > 0.0:
            return np.vstack([shape, np.zeros(len(azimuth_rad))])
        step_s, raised = TURN_STEP_RAD / size, []
        for later_s in (-step_s, step_s):
            azimuth, elevation = turn_sky(azimuth_rad, horizon_rad, R_from_rotvec(later_s * turn), terrain.air)
            raised.append(np.asarray(terrain.horizon_rad(position_m[None], azimuth)).ravel() - elevation)
        return np.vstack([shape, (raised[1] - raised[0]) / (2 * step_s)])

    @cached_property
    def _scales(self) -> Ints:
        """Indices of the errors that scale a round crater, and the position with it."""
        return np.flatnonzero([one.scales and self.axisymmetric for one in self.listed])

    def true_positions(self, points: Array, values: Array) -> Array:
        """Positions (n, 2) [m]: `points` (n, 2) turned and scaled by the errors' `values` (n, k) in a round crater."""
        points = points * np.maximum(1.0 + values[:, self._scales].sum(axis=1, keepdims=True), LEAST_SIZE)
        if self.clock is None or not self.axisymmetric:
            return points
        angle = self.clock.turn_rad_s[2] * values[:, -1]
        c, s = np.cos(angle), np.sin(angle)
        return np.stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]], axis=1)


def _sigma(errors: Sequence[ShapeError], gross: str) -> Array:
    """Standard deviations (k,) of `errors`; those of the fact `gross` are of a gross error."""
    wide = np.array([one.gross_sigma for one in errors])
    least = np.maximum([one.sigma for one in errors], RESIDUAL_PART * wide)
    return np.where([one.fact == gross for one in errors], wide, least)


def _known_errors(terrain: Terrain, clock: Clock | None) -> list[ShapeError]:
    """The errors of a `terrain`, and of a `clock`, those that are stated as zero too."""
    return [*terrain.errors.shape, *([] if clock is None else [_clock_error(clock, terrain)])]


def is_noticeable(clock: Clock, error_s: float, terrain: Terrain) -> bool:
    """Whether an error `error_s` [s] of a clock moves a row noticeably over the search area of a terrain."""
    return error_s * float(np.linalg.norm(clock.turn_rad_s)) * terrain.reach_m > NEGLIGIBLE_M


def _clock_error(clock: Clock, terrain: Terrain) -> ShapeError:
    """The error of a `clock`; zero where it moves no position on a `terrain` noticeably."""
    noticed = is_noticeable(clock, max(clock.sigma_s, clock.gross_sigma_s * (clock.gross_probability > 0.0)), terrain)
    return ShapeError(
        name="clock_s", fact=CLOCK_FACT, sigma=clock.sigma_s if noticed else 0.0,
        gross_probability=clock.gross_probability if noticed else 0.0, gross_sigma=clock.gross_sigma_s,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class ErrorBasis:
    """Values of the k shared errors: mean + shown z + hidden y, with z and y normal of unit variance."""

    gross: str  # fact with a gross error; "": none
    log_probability: float  # of that
    mean: Array  # (k,)
    shown: Array  # (k, a) directions that the rows show
    hidden: Array  # (k, b)
    drift_m: Array  # (b, 2) move of the position that leaves the skyline as it is, by one unit of each hidden one

    @classmethod
    def of(
        cls,
        errors: SharedErrors,
        gross: str,
        slopes_rad: Array,
        position_slopes: Array,
        moments: SectorMoments,
        reach_m: float,
    ) -> ErrorBasis:
        """Basis of `errors` that raise the skyline by `slopes_rad` (k, n), as a position by `position_slopes` (2, n).

        The position is known to `reach_m` before. `gross` names the fact with a gross error, "" none. `moments` are
        those of the skyline that the rows show.
        """
        sigma = errors.sigma(gross)
        weight = 1.0 / moments.variance_rad2
        rise, moved = sigma[:, None] * slopes_rad, position_slopes
        normal = (moved * weight) @ moved.T + reach_m**-2.0 * np.eye(2)
        to_move = np.linalg.solve(normal, (moved * weight) @ rise.T)  # (2, k) of the position, by each error
        left = rise - to_move.T @ moved
        information, axes = np.linalg.eigh((left * weight) @ left.T)
        is_shown = information > LEAST_INFORMATION
        hidden = axes[:, ~is_shown]
        return cls(
            gross, errors.log_probability(gross), errors.mean, sigma[:, None] * axes[:, is_shown],
            sigma[:, None] * hidden, -(to_move @ hidden).T,
        )  # fmt: skip

    @classmethod
    def whole(cls, errors: SharedErrors) -> ErrorBasis:
        """Basis of all `errors` in their own units, as directions of their own, about zero."""
        k = len(errors)
        return cls("", 0.0, np.zeros(k), np.eye(k), np.zeros((k, 0)), np.zeros((0, 2)))

    def __len__(self) -> int:
        return self.shown.shape[1]

    def values(self, shown: Array, hidden: Array) -> Array:
        """Values (n, k) of the errors at coordinates (n, a) and (n, b)."""
        return np.asarray(self.mean + shown @ self.shown.T + hidden @ self.hidden.T)

    def parameters(self, positions_m: Array, off: Array) -> Array:
        """Parameters (n, 2 + a) of `positions_m` (n, 2) [m] with errors that are `off` (n, k) the mean.

        The positions are those before the turn of a round crater.
        """
        at = np.linalg.solve(np.hstack([self.shown, self.hidden]), off.T).T
        shown, hidden = np.split(at, [len(self)], axis=1)
        return np.hstack([positions_m - hidden @ self.drift_m, shown])

    def log_prior(self, shown: Array) -> Array:
        """Logarithm (n,) of the prior density of coordinates (n, a), with the probability of the hypothesis."""
        norm = 0.5 * shown.shape[1] * np.log(2 * np.pi)
        return np.asarray(self.log_probability - norm - 0.5 * np.square(shown).sum(axis=1))
