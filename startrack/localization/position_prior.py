"""A prior of the position: the search near it, the posterior with it, and its contradiction by the evidence."""

from __future__ import annotations

from typing import Any

import numpy as np

from startrack.core.types import Array, Bools, NotLocated, PositionPrior
from startrack.localization.places import Place
from startrack.terrain import ForwardingTerrain, Terrain

DISK_SIGMAS = 6.0  # of the prior, to the edge of the first disk
LEAST_REACH_M = 300.0  # of that radius: in a smaller disk few edges of evidence show which way is likelier
EDGE_PART, ENLARGED = 0.7, 3.0  # of the disk's radius, where its edge begins; factor of the next radius
CONTRADICTED_SIGMAS = 4.5  # of evidence and prior together: a true prior is farther off once in 25,000 images


class SearchedNear(ForwardingTerrain):
    """A terrain of which the neighbourhood of a prior's mean is searched."""

    def __init__(self, whole: Terrain, near: PositionPrior, radius_m: float | None = None) -> None:
        super().__init__(whole)
        self.near_prior, self.radius_m = near, radius_m or max(DISK_SIGMAS * near.sigma_m, LEAST_REACH_M)

    @property
    def searched(self) -> tuple[float, float, float]:  # type: ignore[override]
        """Disk of the prior: east and north of its middle, and its radius [m]."""
        return float(self.near_prior.east_m), float(self.near_prior.north_m), float(self.radius_m)

    def allowed(self, points_m: Array) -> Bools:
        """Whether a camera could stand at the points (..., 2), within the disk."""
        east, north, reach = self.searched
        inside = np.hypot(points_m[..., 0] - east, points_m[..., 1] - north) <= reach
        return np.asarray(inside & self.whole.allowed(points_m))

    def is_at_edge(self, places: list[Place]) -> bool:
        """Whether the likeliest of `places` is at the edge of the disk, within the search area."""
        if self.radius_m > 2 * self.reach_m or not places:
            return False
        return bool(np.linalg.norm(places[0].position_m - self.near_prior.mean_m) > EDGE_PART * self.radius_m)

    def enlarged(self) -> SearchedNear:
        """Copy of this terrain with a larger disk."""
        return SearchedNear(self.whole, self.near_prior, ENLARGED * self.radius_m)


def require_prior_inside(nearby: SearchedNear) -> None:
    """Raise NotLocated (outside_search_area) where no part of the disk of a prior is in the search area."""
    east_m, north_m, radius_m = nearby.searched
    away_m = float(np.hypot(east_m, north_m))
    if away_m > nearby.reach_m + radius_m:
        raise NotLocated(
            f"--near {nearby.near_prior} is {away_m:.0f} m from the origin of the terrain, and the radius of its "
            f"search area is {nearby.search_radius_m:.0f} m",
            reason="outside_search_area",
        )


def require_agreement(places: list[Place], near: PositionPrior) -> None:
    """Raise NotLocated (inconsistent_evidence) where the prior contradicts the likely `places`, the best first.

    Of two normal distributions the maximum of the product lies chi^2 / 2 below the product of the maxima.
    """
    if not places:
        return
    off = np.array([one.position_m for one in places]) - near.mean_m
    both = np.array([one.covariance_m2 for one in places]) + near.sigma_m**2 * np.eye(2)
    chi2 = np.einsum("ni,ni->n", off, np.linalg.solve(both, off[:, :, None])[:, :, 0])
    lost = places[0].log_likelihood - max(one.log_likelihood - 0.5 * c for one, c in zip(places, chi2, strict=True))
    if lost > 0.5 * CONTRADICTED_SIGMAS**2:
        raise contradiction(near, f"lie {np.sqrt(2 * lost):.1f} sigma from it")


def contradiction(near: PositionPrior, how: str) -> NotLocated:
    """The refusal of evidence that contradicts the prior."""
    return NotLocated(
        f"the positions that the image allows {how}, the prior --near {near}: is it right, and its sigma large enough?",
        reason="inconsistent_evidence",
    )


def name_prior(refusal: NotLocated, near: PositionPrior | None) -> NotLocated:
    """The `refusal`, with the prior in its message where there is one: a wrong prior causes it too."""
    if near is None or "--near" in str(refusal):
        return refusal
    evidence: dict[str, Any] = refusal.evidence
    return NotLocated(
        f"{refusal} (searched within 6 sigma of --near {near}: is it right?)", reason=refusal.reason, **evidence
    )
