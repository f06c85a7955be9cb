"""The evidence of the stars by sectors of azimuth, beside the horizon of the map at the position found."""

from __future__ import annotations

from typing import Any

import numpy as np

from startrack.core.types import Array, Bools, Evidence
from startrack.localization.sector_likelihood import Sectors
from startrack.output.html.details import Horizon
from startrack.output.html.stars import MeasuredStars

SECTORS = 72  # of 5 degrees: wide enough for some stars near the skyline, narrow enough to show a boulder
NEAR_RAD = np.radians(3.0)  # to either side of the skyline
COARSE_AZIMUTHS = 721
COARSE_ERROR_RAD = np.radians(1.0)  # a ridge between two coarse azimuths: nearer stars get their own horizon
NATS_DECIMALS = 2
SURE_LLR = 4.0  # of stars that decide; of weaker ones some level skyline always fits the noise better
CONTRADICTED_NATS = -3.0  # of one sector


def sectors_of(stars: MeasuredStars, horizon: Horizon) -> dict[str, Any] | None:
    """What the `stars` near the `horizon` show in SECTORS sectors from north through east; None without stars.

    `near_deg`: how near. `above` and `below` the horizon: numbers of stars there that are `seen` and `hidden`.
    `supports` and `opposes`: sums of |evidence| [nats] of near stars that agree with the horizon and that do not.
    `nats`: log-likelihood of the horizon beside the best one that is shifted up or down in this sector alone, from the
    stars whose evidence is sure; 0 is perfect, None without such stars. A sector below `contradicted_nats`
    contradicts the position.
    """
    above_rad = _heights_rad(stars, horizon)
    near = np.abs(above_rad) < NEAR_RAD  # False where it is not known
    if not near.any():
        return None
    sector = (stars.azimuth_rad / (2 * np.pi) * SECTORS).astype(int) % SECTORS
    above, agrees = above_rad > 0, (above_rad > 0) == (stars.llr > 0)

    def count(side: Bools, status: str) -> list[int]:
        chosen = near & side & (stars.status == status)
        return [int(number) for number in np.bincount(sector[chosen], minlength=SECTORS)]

    def total(chosen: Bools) -> list[float]:
        chosen = near & chosen
        weights = np.abs(stars.llr[chosen])
        return _rounded(np.bincount(sector[chosen], weights=weights, minlength=SECTORS).astype(np.float64))

    sure = np.isfinite(above_rad) & (np.abs(stars.llr) > SURE_LLR)
    return {
        "near_deg": round(float(np.degrees(NEAR_RAD)), 3),
        "contradicted_nats": CONTRADICTED_NATS,
        "above": {status: count(above, status) for status in ("seen", "hidden")},
        "below": {status: count(~above, status) for status in ("seen", "hidden")},
        "supports": total(agrees),
        "opposes": total(~agrees),
        "nats": _rounded(_nats_by_sector(stars.azimuth_rad[sure], above_rad[sure], stars.llr[sure])),
    }


def _heights_rad(stars: MeasuredStars, horizon: Horizon) -> Array:
    """Heights (n,) of the stars above the horizon; of stars far from it to COARSE_ERROR_RAD."""
    azimuth = np.linspace(0.0, 2 * np.pi, COARSE_AZIMUTHS)
    above_rad = stars.elevation_rad - np.interp(stars.azimuth_rad, azimuth, horizon(azimuth))
    near = np.abs(above_rad) < NEAR_RAD + COARSE_ERROR_RAD
    above_rad[near] = stars.elevation_rad[near] - horizon(stars.azimuth_rad[near])
    return above_rad


def _nats_by_sector(azimuth_rad: Array, above_rad: Array, llr: Array) -> Array:
    """Log-likelihood (SECTORS,) of the horizon beside the best shifted one; nan where a sector has no row.

    Elevations are counted from the horizon, so that the best level skyline of a sector is the horizon shifted.
    """
    evidence = Evidence(azimuth_rad=azimuth_rad, elevation_rad=np.clip(above_rad, -np.pi / 2, np.pi / 2), llr=llr)
    sectors = Sectors(evidence, SECTORS, epsilon=0.0)
    visible = np.where(above_rad > 0, llr, 0.0)
    sums = np.bincount(sectors.sector, weights=visible, minlength=SECTORS).astype(np.float64)
    occupied = np.bincount(sectors.sector, minlength=SECTORS) > 0
    return np.where(occupied, sectors.by_sector(sums), np.nan)


def _rounded(values: Array) -> list[Any]:
    """Values for JSON, None for nan."""
    return [round(value, NATS_DECIMALS) + 0.0 if np.isfinite(value) else None for value in values.tolist()]
