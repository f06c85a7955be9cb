"""Does the fix explain the evidence, and better than a wrong map would? Refuse rather than guess."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from startrack.localization.grid_search import scores, taken
from startrack.localization.horizon_bias import raised
from startrack.localization.local_search import COMPASS
from startrack.localization.misfit import FIRST_STEP_M, LAST_STEP_M, STRETCHES, stretch_of_ground, turn_of_sky
from startrack.localization.prefix_sums import Profile
from startrack.localization.sector_likelihood import Sectors, contribution
from startrack.terrain import Cylinder, Terrain
from startrack.types import Array, Evidence, Fix, NotLocated

SURE_LLR = 4.0
CLEAR_OF_SKYLINE_RAD = np.radians(0.5)
NEAR_SKYLINE_RAD = np.radians(15.0)
SECTOR_RAD = np.radians(5.0)
MOST_CONTRADICTED_SECTORS = 0.15  # a boulder of 20 degrees is 6 % of the horizon
SECTOR_CONTRADICTED = 0.2  # part of a sector's sure rays that contradict the fix
FEWEST_IN_SECTOR = 3

USUAL_HORIZON_RAD = 0.3  # sin H cos H of a crater's rim at 20 degrees: d(tan H) / tan H = dH / (sin H cos H)
EXPLAINED_SECTOR_RAD = np.radians(1.5)
LEAST_EXPLAINED_NATS = -0.75  # 0 to -0.35 at the right place, up to 0.5 lower with a ridge on no map; -9.2 the worst
CONTRADICTED_NATS = -3.0  # of one sector
MOST_NAMED = 3
MOST_SEPARATE = 7  # at right places 0 to 3 were seen, and 9 or more where the sky was turned by 6 degrees and more
STRETCH_WINDOW_RAD = np.radians(4.0)
TELLING_LLR = 0.3
STRETCH_GAIN_NATS = 4.5  # a true map gains more in 1 of 370; of 240 images with maps 1 % off the least gain was 7.6
STRETCH_SIGMAS = 3.0  # of what the terrain file itself admits
TURN_GAIN_NATS = 5.0  # of 80 true frames the largest gain was 4.1; of 30 with a clock an hour off half gain more than 5
TURN_SIGMA_RAD = np.radians(0.02)  # errors of a map go together from azimuth to azimuth, and fit chance turns as well

Sure = tuple[Evidence, Array]


def check_consistency(evidence: Evidence, fix: Fix, terrain: Terrain, compiled: bool = False) -> None:
    """Raise NotLocated (inconsistent_evidence) where too much of the `evidence` contradicts the fix, or the map does.

    `compiled` asks for numba where the terrain allows it: the same answer, sooner.
    """
    evidence = raised(evidence, fix.horizon_error_rad)
    sure = _sure(evidence, fix, terrain)
    by_sector = explained_by_sector(evidence, fix, terrain, sure)
    stretches = contradicted_stretches(by_sector)
    contradicted = contradicted_part(evidence, fix, terrain, sure)
    if contradicted > MOST_CONTRADICTED_SECTORS:
        raise NotLocated(
            f"{100 * contradicted:.0f} % of the horizon contradicts the best place{_at_azimuths(stretches)}: "
            "wrong terrain, time or camera file, or something on no map?",
            reason="inconsistent_evidence",
        )
    explained = float(by_sector.mean())
    if explained < LEAST_EXPLAINED_NATS:
        raise NotLocated(
            f"the best place explains the stars badly ({explained:.1f} nats a sector; usual: 0 to -0.3)"
            f"{_at_azimuths(stretches)}: wrong terrain, time or camera file, or something on no map?",
            reason="inconsistent_evidence",
        )
    if len(stretches) > MOST_SEPARATE and not isinstance(terrain, Cylinder):
        raise NotLocated(
            f"the best place is contradicted at {len(stretches)} separate stretches of the horizon, as with a wrong "
            "time: are the image's time, the terrain and the camera file right?",
            reason="inconsistent_evidence",
        )
    if isinstance(terrain, Cylinder):
        stretch, gain = best_stretch(evidence, fix, terrain, compiled)
    else:
        sectors = Sectors.of(evidence, EXPLAINED_SECTOR_RAD, 1e-4)
        profile = Profile.of(sectors)
        stretch, gain = stretch_of_ground(sectors, profile, fix.position_enu_m[:2], terrain)
    if gain > STRETCH_GAIN_NATS and abs(stretch - 1) > STRETCH_SIGMAS * admitted_stretch(terrain):
        raise NotLocated(
            f"the stars see a horizon about {_percent(stretch)} {'higher' if stretch > 1 else 'lower'} than the "
            f"terrain {terrain.name} gives: are the image's time, the terrain's depth and width, its camera height and "
            "the camera file right? (a cylinder can take depth_sigma_m and diameter_sigma_m)",
            reason="inconsistent_evidence",
        )
    if not isinstance(terrain, Cylinder):  # there a turned sky only turns the place
        turn, gain = turn_of_sky(sectors, profile, fix.position_enu_m[:2], terrain)
        sigma = float(np.median(terrain.horizon_sigma_rad(fix.position_enu_m[None, :2], sure[0].azimuth_rad)))
        if gain > TURN_GAIN_NATS * (1 + sigma / TURN_SIGMA_RAD):
            raise NotLocated(
                f"a sky turned by {np.degrees(turn):+.1f} degrees about the vertical would fit the terrain better: "
                "is the time right? (an hour on the Moon is 0.55 degrees)",
                reason="inconsistent_evidence",
            )


def _sure(evidence: Evidence, fix: Fix, terrain: Terrain) -> Sure:
    rays = taken(evidence, np.abs(evidence.llr) > SURE_LLR)
    return rays, np.asarray(terrain.horizon_rad(fix.position_enu_m[None, :2], rays.azimuth_rad))


def explained_by_sector(evidence: Evidence, fix: Fix, terrain: Terrain, sure: Sure | None = None) -> Array:
    """Log-likelihood (sectors,) of the horizon at the fix, beside the best level skyline in each sector; 0 is perfect.

    Only rays that are sure of themselves are asked: of the others, some level skyline always fits the noise better.
    0 for a cylinder whose shape is uncertain: the fix was made with another one than the file's. `sure` are those rays
    and the horizon at their azimuths, where they are known.
    """
    rays, horizon = sure or _sure(evidence, fix, terrain)
    sectors = Sectors.of(rays, EXPLAINED_SECTOR_RAD, 1e-4)
    if isinstance(terrain, Cylinder) and admitted_stretch(terrain) > 0:
        return np.zeros(sectors.count)
    sigma = np.hypot(rays.edge_sigma_rad, terrain.horizon_sigma_rad(fix.position_enu_m[None, :2], rays.azimuth_rad))
    value = contribution(rays.llr, rays.elevation_rad, horizon, sigma)
    sums = np.bincount(sectors.sector, weights=value, minlength=sectors.count).astype(np.float64)
    return sectors.by_sector(sums)


def contradicted_stretches(by_sector: Array) -> list[tuple[int, int]]:
    """First sector and number of each run that contradicts the fix; a single good one between them is no gap.

    An obstacle on no map makes one run, however wide; a wrong time, that turns the whole skyline, makes many.
    """
    wrong = by_sector < CONTRADICTED_NATS
    wrong |= np.roll(wrong, 1) & np.roll(wrong, -1)
    if wrong.all():
        return [(0, len(wrong))]
    good = int(np.argmin(wrong))  # begun there, no run is cut in two
    changes = np.flatnonzero(np.diff(np.roll(wrong, -good), append=False)) + 1
    return [(int(start + good) % len(wrong), int(end - start)) for start, end in changes.reshape(-1, 2)]


def _at_azimuths(stretches: list[tuple[int, int]]) -> str:
    """The widest of them in words, for a message."""
    if not stretches:
        return ""
    width = np.degrees(EXPLAINED_SECTOR_RAD)
    widest = sorted(sorted(stretches, key=lambda one: -one[1])[:MOST_NAMED])
    words = [f"{width * start:.0f} to {(width * (start + count)) % 360:.0f}" for start, count in widest]
    return f", most at azimuths {', '.join(words)} degrees"


def admitted_stretch(terrain: Terrain) -> float:
    """Relative error (one sigma) of the horizon that the terrain file admits: the fix has it in its covariance."""
    if isinstance(terrain, Cylinder):
        return float(np.hypot(terrain.depth_sigma_m / terrain.depth_m, terrain.diameter_sigma_m / terrain.diameter_m))
    return terrain.common_sigma_rad / USUAL_HORIZON_RAD


def _percent(stretch: float) -> str:
    size = abs(stretch - 1)
    return f"{100 * size:.1f} %" + (" or more" if size >= STRETCHES[-1] - 1e-9 else "")


def contradicted_part(evidence: Evidence, fix: Fix, terrain: Terrain, sure: Sure | None = None) -> float:
    """Part of the horizon's sectors that contradict the fix; `sure` as in `explained_nats`.

    Only rays that are sure of themselves, near the fix's skyline and yet well clear of it are asked: a few contradicted
    sectors are an obstacle or a defect, many are a wrong map, time or identification.
    """
    rays, horizon = sure or _sure(evidence, fix, terrain)
    above = rays.elevation_rad - horizon
    asked = (np.abs(above) > CLEAR_OF_SKYLINE_RAD) & (np.abs(above) < NEAR_SKYLINE_RAD)
    sector = (rays.azimuth_rad / SECTOR_RAD).astype(int)
    count = np.bincount(sector, weights=asked)
    wrong = np.bincount(sector, weights=asked & ((rays.llr > 0) != (above > 0)))
    known = count >= FEWEST_IN_SECTOR
    return float(np.mean(wrong[known] > SECTOR_CONTRADICTED * count[known])) if known.any() else 0.0


def best_stretch(evidence: Evidence, fix: Fix, terrain: Terrain, compiled: bool = False) -> tuple[float, float]:
    """The stretch of the terrain's height that fits best, and how much better [nats] than the terrain as it is.

    tan H -> s tan H for all azimuths, the position free: a wrong depth, width or camera height shows as s != 1, while a
    wrong position cannot. Asked in the form tan e -> tan e / s, so that no terrain needs to know of it.
    """
    start = fix.position_enu_m[None, :2]
    if not isinstance(terrain, Cylinder):
        sectors = Sectors.of(evidence, EXPLAINED_SECTOR_RAD, 1e-4)
        return stretch_of_ground(sectors, Profile.of(sectors), start[0], terrain)
    below = evidence.elevation_rad - terrain.horizon_rad(start, evidence.azimuth_rad)
    near = taken(evidence, (np.abs(below) < STRETCH_WINDOW_RAD) & (np.abs(evidence.llr) > TELLING_LLR))
    if not len(near):
        return 1.0, 0.0
    climb = _climber(near, terrain) if compiled else best_near
    middle, plain = climb(start, near, terrain)
    best_stretch, best = 1.0, plain
    for sign in (1, -1):
        place = middle
        for stretch in (1 + sign * size for size in STRETCHES):
            place, fit = climb(place, _lowered(near, stretch), terrain)
            if fit > best:
                best_stretch, best = stretch, fit
    return best_stretch, best - plain


def _climber(evidence: Evidence, terrain: Terrain) -> Callable[[Array, Evidence, Terrain], tuple[Array, float]]:
    """`best_near`, compiled where every ray's visible ground is a disk."""
    from startrack.localization.compiled import applies, climbed

    if not (isinstance(terrain, Cylinder) and applies(evidence, terrain)):
        return best_near
    return lambda start, rays, _: climbed(start, rays, terrain, FIRST_STEP_M, LAST_STEP_M)


def _lowered(evidence: Evidence, stretch: float) -> Evidence:
    return Evidence(
        azimuth_rad=evidence.azimuth_rad,
        elevation_rad=np.arctan(np.tan(evidence.elevation_rad) / stretch),
        llr=evidence.llr,
        edge_sigma_rad=evidence.edge_sigma_rad,
    )


def best_near(
    start_m: Array, evidence: Evidence, terrain: Terrain, first_step_m: float = FIRST_STEP_M
) -> tuple[Array, float]:
    """Best place (1, 2) near the start and its log-likelihood: steps to the best of 8 neighbours, ever shorter.

    A plain sum, no sectors.
    """
    sectors = Sectors.of(evidence, 2 * np.pi, 0.0)
    place, step, best = start_m, first_step_m, -np.inf
    while step >= LAST_STEP_M:
        around = place + step * COMPASS
        around = around[np.asarray(terrain.allowed(around))]
        score = scores(around, evidence, sectors, terrain) + sectors.ceiling.sum()
        top = int(np.argmax(score)) if len(score) else 0
        if not len(score) or score[top] <= best:
            step /= 2
            continue
        place, best = around[top : top + 1], float(score[top])
    return place, best
