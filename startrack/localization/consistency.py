"""Does the fix explain the evidence, and better than a wrong map or clock would? Refuse rather than guess."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from startrack.localization.likelihood import SECTOR_EPSILON, SECTOR_RAD, PositionLikelihood
from startrack.localization.nuisance import lower_evidence
from startrack.localization.sector_likelihood import Sectors, contributions
from startrack.localization.stretch import STRETCH_GAIN_NATS, STRETCHES, best_stretch
from startrack.localization.time_check import check_time
from startrack.terrain import Terrain
from startrack.types import Array, Evidence, Fix, NotLocated

SURE_LLR = 4.0
CLEAR_OF_SKYLINE_RAD = np.radians(0.5)
NEAR_SKYLINE_RAD = np.radians(15.0)
WIDE_SECTOR_RAD = np.radians(5.0)
MAX_CONTRADICTED_PART = 0.15  # a boulder of 20 degrees is 6 % of the horizon
SECTOR_CONTRADICTED = 0.2  # part of a sector's sure rays that contradict the fix
MIN_IN_SECTOR = 3

USUAL_HORIZON_RAD = 0.3  # sin H cos H of a crater's rim at 20 degrees: d(tan H) / tan H = dH / (sin H cos H)
MIN_EXPLAINED_NATS = -0.75  # 0 to -0.35 at the right place, up to 0.5 lower with a ridge on no map; -9.2 the worst
CONTRADICTED_NATS = -3.0  # of one sector
NAMED_STRETCHES = 3
MAX_SEPARATE = 7  # at right positions 0 to 3 were seen, and 9 or more where the sky was turned by 6 degrees and more

STRETCH_SIGMAS = 3.0  # of what the terrain file itself admits


@dataclass(frozen=True, eq=False)
class SureRows:
    """The rows of great |llr|, and the horizon at a fix, traced once.

    Of weaker rows some level skyline always fits the noise better than the true one.
    """

    evidence: Evidence
    fix: Fix
    terrain: Terrain
    horizon_rad: Array  # (n,) at the rows' azimuths

    @classmethod
    def at_fix(cls, evidence: Evidence, fix: Fix, terrain: Terrain) -> SureRows:
        """Those of the evidence, at the position of a fix on a terrain."""
        rows = evidence.take(np.abs(evidence.llr) > SURE_LLR)
        horizon = terrain.horizon_rad(fix.position_enu_m[None, :2], rows.azimuth_rad)
        return cls(rows, fix, terrain, np.asarray(horizon))

    @cached_property
    def sectors(self) -> Sectors:
        """The rows in sectors of azimuth."""
        return Sectors.from_evidence(self.evidence, SECTOR_RAD, SECTOR_EPSILON)

    @cached_property
    def above_rad(self) -> Array:
        """(n,) how far the rows stand above the horizon."""
        return self.evidence.elevation_rad - self.horizon_rad

    @cached_property
    def explained_by_sector(self) -> Array:
        """Log-likelihood (sectors,) of the horizon, beside the best level skyline in each sector; 0 is perfect.

        All zero for a terrain of uncertain shape: the fix was made with another shape than the file's.
        """
        rows, sectors = self.evidence, self.sectors
        if any(self.terrain.shape_sigma):
            return np.zeros(sectors.count)
        map_sigma = self.terrain.horizon_sigma_rad(self.fix.position_enu_m[None, :2], rows.azimuth_rad)
        sigma = np.hypot(rows.edge_sigma_rad, map_sigma)
        value = contributions(rows.llr, rows.extended_nats, rows.elevation_rad, self.horizon_rad, sigma)
        sums = np.bincount(sectors.sector, weights=value, minlength=sectors.count).astype(np.float64)
        return sectors.by_sector(sums)

    def explained_nats(self) -> float:
        """Mean of `explained_by_sector` over the sectors with rows near the skyline of the fix.

        The others, such as those outside the picture, can contradict no position.
        """
        sector = self.sectors.sector[np.abs(self.above_rad) < NEAR_SKYLINE_RAD]
        return float(self.explained_by_sector[np.unique(sector)].mean()) if len(sector) else 0.0

    def contradicted_part(self) -> float:
        """Part of the horizon's sectors that contradict the fix.

        Only rows near its skyline and yet well clear of it count: a few contradicted sectors are an obstacle or a
        defect, many are a wrong map, time or identification.
        """
        rows, above = self.evidence, self.above_rad
        counted = (np.abs(above) > CLEAR_OF_SKYLINE_RAD) & (np.abs(above) < NEAR_SKYLINE_RAD)
        sector = (rows.azimuth_rad / WIDE_SECTOR_RAD).astype(int)
        count = np.bincount(sector, weights=counted)
        wrong = np.bincount(sector, weights=counted & ((rows.llr > 0) != (above > 0)))
        known = count >= MIN_IN_SECTOR
        return float(np.mean(wrong[known] > SECTOR_CONTRADICTED * count[known])) if known.any() else 0.0


def check_consistency(evidence: Evidence, fix: Fix, terrain: Terrain) -> None:
    """Raise NotLocated (inconsistent_evidence) where the `evidence` contradicts the `fix`, `terrain` or time."""
    evidence = lower_evidence(evidence, fix.horizon_error_rad)
    sure = SureRows.at_fix(evidence, fix, terrain)
    stretches = contradicted_stretches(sure.explained_by_sector)
    contradicted = sure.contradicted_part()
    if contradicted > MAX_CONTRADICTED_PART:
        raise _inconsistency(f"{100 * contradicted:.0f} % of the horizon contradicts the best position", stretches)
    explained = sure.explained_nats()
    if explained < MIN_EXPLAINED_NATS:
        raise _inconsistency(
            f"the best position explains the strongest rows badly ({explained:.1f} nats a sector; usual: 0 to -0.3)",
            stretches,
        )
    if len(stretches) > MAX_SEPARATE and not terrain.axisymmetric:
        raise NotLocated(
            f"the best position is contradicted at {len(stretches)} separate stretches of the horizon, as with a wrong "
            "time: are the image's time, the terrain and the camera file right?",
            reason="inconsistent_evidence",
        )
    likelihood = PositionLikelihood.from_evidence(evidence, terrain)
    _check_stretch(likelihood, fix.position_enu_m[:2])
    if evidence.clock is not None and not terrain.axisymmetric:  # else a turned sky only turns the position
        check_time(likelihood, fix.position_enu_m[:2], evidence.clock)


def _check_stretch(likelihood: PositionLikelihood, position_m: Array) -> None:
    """Raise NotLocated where a stretched horizon explains the stars much better than the terrain's."""
    terrain = likelihood.terrain
    stretch, gain = best_stretch(likelihood, position_m)
    if gain > STRETCH_GAIN_NATS and abs(stretch - 1) > STRETCH_SIGMAS * admitted_stretch(terrain):
        raise NotLocated(
            f"the stars see a horizon about {_percent(stretch)} {'higher' if stretch > 1 else 'lower'} than the "
            f"terrain {terrain.name} gives: are the image's time, the terrain's depth and width, its camera height and "
            "the camera file right? (a cylinder can take depth_sigma_m and diameter_sigma_m)",
            reason="inconsistent_evidence",
        )


def contradicted_stretches(by_sector: Array) -> list[tuple[int, int]]:
    """First sector and number of each run that contradicts the fix; a single good one between them is no gap.

    An obstacle on no map makes one run, however wide; a wrong time, which turns the whole skyline, makes many.
    """
    wrong = by_sector < CONTRADICTED_NATS
    wrong |= np.roll(wrong, 1) & np.roll(wrong, -1)
    if wrong.all():
        return [(0, len(wrong))]
    good = int(np.argmin(wrong))  # begun there, no run is cut in two
    changes = np.flatnonzero(np.diff(np.roll(wrong, -good), append=False)) + 1
    return [(int(start + good) % len(wrong), int(end - start)) for start, end in changes.reshape(-1, 2)]


def admitted_stretch(terrain: Terrain) -> float:
    """Relative error (one sigma) of the horizon that the terrain file admits: the fix has it in its covariance."""
    return float(np.hypot(terrain.shape_sigma[0], terrain.common_sigma_rad / USUAL_HORIZON_RAD))


def _inconsistency(cause: str, stretches: list[tuple[int, int]]) -> NotLocated:
    return NotLocated(
        f"{cause}{_at_azimuths(stretches)}: wrong terrain, time or camera file, or something on no map?",
        reason="inconsistent_evidence",
    )


def _at_azimuths(stretches: list[tuple[int, int]]) -> str:
    """The widest stretches in words, for a message."""
    if not stretches:
        return ""
    width = np.degrees(SECTOR_RAD)
    widest = sorted(sorted(stretches, key=lambda one: -one[1])[:NAMED_STRETCHES])
    words = [f"{width * start:.0f} to {(width * (start + count)) % 360:.0f}" for start, count in widest]
    return f", most at azimuths {', '.join(words)} degrees"


def _percent(stretch: float) -> str:
    size = abs(stretch - 1)
    return f"{100 * size:.1f} %" + (" or more" if size >= STRETCHES[-1] - 1e-9 else "")
