"""Pixels of the diffuse sky and the ground near a predicted skyline, without those that show stars or defects."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np

from startrack.camera import Camera
from startrack.core.types import MIDDLES_RAD, Array, Bools, Detections, Ints, sector_of
from startrack.evidence.skyline import (
    BAND_PX,
    CLIP_SHIFT_PX,
    MOST_REACH_PX,
    SKYLINE_SIGMAS,
    Skyline,
    SkylineEstimate,
    look_through,
    scale_across,
    skyline_band,
)
from startrack.evidence.star_photometer import StarPhotometry, filtered_noise_e
from startrack.frames import azel_from_rays
from startrack.kernels.library import kernel
from startrack.psf import noise_area_px

MASKED_SIGMA = 0.4  # light of a known star, in a pixel's noise, from which the pixel is left out
CIRCLE_EDGE_PX = 3.0  # beside the end of the image circle
UNRESOLVED_PX2 = 1.0 / 12.0  # variance of the position in a pixel


@dataclass(frozen=True, eq=False)
class SkyPixels:
    """Pixels (n,) near a predicted skyline that show no star, each with its direction and its light."""

    azimuth_rad: Array  # in enu
    px_per_rad: Array  # of elevation, across the skyline
    height_px: Array  # above the skyline, across it
    light_e: Array
    edge_px: float  # width of a sharp edge in the image: the PSF and the pixel
    reach_px: Array  # (SECTORS,) no farther from the predicted skyline is the true one; infinite: not known


@dataclass(frozen=True, eq=False)
class SkylineBand:
    """The pixels (n,) of an image near a predicted skyline, each with its direction."""

    detections: Detections
    estimate: SkylineEstimate
    to_px: Skyline  # pixels per radian of elevation, across the skyline
    whole: Bools  # (H, W) of the band, with dead pixels and some to spare
    pixel: Ints  # in the flat image
    azimuth_rad: Array  # in enu
    px_per_rad: Array  # of elevation, across the skyline
    height_px: Array  # above the skyline, across it
    reach_px: Array  # (SECTORS,) no farther from the predicted skyline is the true one

    def heights_px(self, azimuth_rad: Array, elevation_rad: Array) -> Array:
        """Heights (n,) [px] of directions `azimuth_rad`, `elevation_rad` (n,) in enu above the skyline, across it."""
        return np.asarray((elevation_rad - self.estimate.skyline(azimuth_rad)) * self.to_px(azimuth_rad))

    def without_stars(self, stars: StarPhotometry) -> SkyPixels:
        """The pixels that show no source, and no star of `stars`, visible or hidden."""
        starless = self.whole.copy()
        _leave_out_stars(starless, self.detections, stars)
        chosen = starless.ravel()[self.pixel]
        return SkyPixels(
            azimuth_rad=self.azimuth_rad[chosen],
            px_per_rad=self.px_per_rad[chosen],
            height_px=self.height_px[chosen],
            light_e=self.detections.image_e.ravel()[self.pixel[chosen]].astype(np.float64),
            edge_px=sqrt(self.detections.psf_sigma_px**2 + UNRESOLVED_PX2),
            reach_px=self.reach_px,
        )


def pixels_near_skyline(
    detections: Detections, camera: Camera, R_cam_enu: Array, estimate: SkylineEstimate
) -> SkylineBand:  # fmt: skip
    """Pixels of the `detections`' image near a skyline, which `camera` and `R_cam_enu` place in the image.

    The band is as much wider as the `estimate` of the skyline is uncertain.
    """
    to_px = scale_across(camera, R_cam_enu, estimate.skyline)
    reach_px = np.maximum(SKYLINE_SIGMAS * estimate.sigma_rad * to_px(MIDDLES_RAD), CLIP_SHIFT_PX)
    reach_px[reach_px > MOST_REACH_PX] = np.inf
    half_px = BAND_PX + np.minimum(reach_px, MOST_REACH_PX) - CLIP_SHIFT_PX
    band = skyline_band(detections.image_e.shape, camera, R_cam_enu, estimate.skyline, float(half_px.max()))
    pixel, rays_cam = look_through(band & ~detections.dead, camera)
    azimuth, elevation = azel_from_rays(rays_cam @ R_cam_enu)
    scale = to_px(azimuth)
    height = (elevation - estimate.skyline(azimuth)) * scale
    limit_rad = min(camera.calibrated_angle_rad, camera.max_angle_rad) - CIRCLE_EDGE_PX / camera.focal_px[0]
    sector = sector_of(azimuth)
    usable = (rays_cam[:, 2] > np.cos(limit_rad)) & (np.abs(height) < half_px[sector])
    usable = np.flatnonzero(usable & np.isfinite(reach_px[sector]))
    rows = pixel[usable], azimuth[usable], scale[usable], height[usable]
    return SkylineBand(detections, estimate, to_px, band, *rows, reach_px)


def _leave_out_stars(band: Bools, detections: Detections, stars: StarPhotometry) -> None:
    """Clear the pixels of the band (H, W) that hold light of known stars, visible or hidden, or of detections."""
    sigma2 = detections.psf_sigma_px**2 + UNRESOLVED_PX2
    noise_e = filtered_noise_e(detections) / sqrt(noise_area_px(detections.psf_sigma_px))
    xy_px = np.concatenate([stars.xy_px, detections.xy_px])
    peak = np.concatenate([stars.expected_e, detections.flux_e]) / (2 * np.pi * sigma2 * max(noise_e, 1e-9))
    bright = np.flatnonzero(peak > MASKED_SIGMA)
    radius = np.ceil(np.sqrt(2 * sigma2 * np.log(peak[bright] / MASKED_SIGMA)) + 0.5)
    _clear_disks(band, np.rint(np.clip(xy_px[bright], -1e6, 1e6)).astype(np.int64), radius.astype(np.int64))


def _clear_disks(mask: Bools, xy_px: Ints, radius_px: Ints) -> None:
    """Clear the pixels of a mask (H, W) within `radius_px` (n,) of the pixels (n, 2).

    A small disk whose middle the mask lacks hardly reaches into the band: it is left out.
    """
    _clear(mask, xy_px, radius_px, BAND_PX / 2, np.empty(len(xy_px), np.bool_))


_clear = kernel(
    "clear_disks", "mask: out bool[height, width]", "xy_px: int64[n, 2]", "radius_px: int64[n]", "large_px: float64",
    "touching: out bool[n]",
)  # fmt: skip
