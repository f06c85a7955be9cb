"""Errors that neighbouring stars share, such as a flex of the lens, in the covariance of a calibration.

The covariance of a fit counts every star as an independent measurement. The means of the residuals over regions of the
image show what is not: their chi-square per degree of freedom is the square of the Birge ratio, by which sigmas are too
small (Birge 1932, Phys. Rev. 40, 207). What a single night cannot show is added as a floor.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta

import numpy as np

from startrack.applications.calibration.acceptance import IMAGE_RINGS, IMAGE_SECTORS, STARS_PER_RING, rings_and_sectors
from startrack.camera import cap_grid, projection_covariance_px2
from startrack.core.types import Ints
from startrack.estimation.adjust import SMALLEST_EXTRA_PX2, Observations, inverse_covariance
from startrack.estimation.frame_matching import JointFit
from startrack.estimation.lens_fit import LensFit, is_chance

# RMS of the projection, per calibration. All-sky camera of the Lowell Discovery Telescope, nights of 2018-06-29 and
# 2018-08-06, each calibrated alone: within 80 degrees the projections differ by 0.063 px; the stars explain 0.021 px.
FLOOR_PX = 0.04
NIGHT_GAP = timedelta(hours=6)  # between exposures of different nights


def widen_covariance(joint: JointFit) -> JointFit:
    """The fit with the covariance of its lens times the squared Birge ratio, and the floor added."""
    ratio = max(
        birge_ratio(joint.fit, joint.points, groups) for groups in (nights(joint), np.arange(len(joint.frames)))
    )
    camera = joint.fit.camera
    if camera.covariance is not None:
        rays = cap_grid(camera.calibrated_angle_rad)
        mean_px2 = float(np.mean(np.trace(projection_covariance_px2(camera, rays), axis1=1, axis2=2)))
        camera = replace(camera, covariance=(ratio**2 + FLOOR_PX**2 / mean_px2) * camera.covariance)
    return replace(joint, fit=replace(joint.fit, camera=camera), birge_ratio=ratio)


def birge_ratio(fit: LensFit, points: Observations, groups: Ints) -> float:
    """Root of the chi-square per degree of freedom of mean residuals in regions of the image; 1 where that is chance.

    `groups` (images,): images with the same number share their regions.
    """
    good = points.take(fit.used)
    _, ring, sector = rings_and_sectors(fit.camera, good)
    region = (groups[good.image] * IMAGE_RINGS + ring) * IMAGE_SECTORS + sector
    count = np.bincount(region)
    weight, weighted = np.zeros((len(count), 2, 2)), np.zeros((len(count), 2))
    inverse = inverse_covariance(good.covariance_px2, max(fit.extra_sigma_px**2, SMALLEST_EXTRA_PX2))
    np.add.at(weight, region, inverse)
    np.add.at(weighted, region, np.einsum("nij,nj->ni", inverse, fit.residual_px[fit.used]))
    enough = count >= STARS_PER_RING
    chi2 = float(np.einsum("ci,cij,cj->", weighted[enough], np.linalg.inv(weight[enough]), weighted[enough]))
    fitted = len(fit.camera.covariance_order) + 3 * len(np.unique(groups))
    freedom = 2 * int(enough.sum()) - fitted
    if freedom < 1 or is_chance(chi2, freedom):
        return 1.0
    return float(np.sqrt(chi2 / freedom))


def nights(joint: JointFit) -> Ints:
    """The number (images,) of the night of each image."""
    times = np.array([frame.time_utc.timestamp() for frame in joint.frames])
    order = np.argsort(times)
    number = np.zeros(len(times), dtype=np.int64)
    number[order] = np.cumsum(np.diff(times[order], prepend=times[order[0]]) > NIGHT_GAP.total_seconds())
    return number
