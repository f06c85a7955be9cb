"""Detector of one's own that finds positions and fluxes alone: the rest of `Detections` is measured here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from startrack.camera import Camera
from startrack.core.types import Array, Detections, Exposure, TooFewStars
from startrack.detection.detector import UNKNOWN_WIDTH_PX, prepare_frame
from startrack.detection.frame import MODEL_ERROR, radius_for
from startrack.detection.peaks import nearest_pixels
from startrack.detection.psf_width import guess_psf_width
from startrack.exposure import touch_masked

PIXEL_VARIANCE_PX2 = 1 / 12  # by which a pixel widens the PSF


@dataclass(frozen=True)
class PositionDetector:
    """Detector around a function `find(exposure) -> (xy_px, flux_adu)`: Exposure -> Detections.

    xy_px (n, 2) counts from the centre of the top-left pixel, x to the right, y down; flux_adu (n,) is that of the
    whole star above its background, in counts of `Exposure.pixels_adu`. Any order will do. Background, noise and PSF
    are measured; the errors are those of a matched filter, so that a coarser method states its own with `sigma_px`.
    """

    find: Callable[[Exposure], Any]
    sigma_px: float | None = None  # of a position per axis; None: that of a matched filter
    psf_sigma_px: float | None = None  # None: measured in the frame

    def __call__(self, exposure: Exposure, camera: Camera | None = None) -> Detections:
        """The sources that `find` returns, brightest first; fluxes in electrons with the camera's gain, else in ADU.

        Sources on masked pixels are left out. Raises TooFewStars (reason no_stars) if there is none, ValueError if
        `find` returns anything else than positions within the frame and as many fluxes above 0.
        """
        xy_px, flux_adu = _checked(self.find(exposure), exposure.size_px)
        source, mask = prepare_frame(exposure, camera)
        sensor = None if camera is None else camera.sensor
        expected_px = UNKNOWN_WIDTH_PX if sensor is None else sensor.psf_sigma_px
        sigma_px = self.psf_sigma_px or guess_psf_width(source.frame, expected_px)
        if mask is not None:
            kept = ~touch_masked(mask.masked, xy_px, radius_for(sigma_px))
            xy_px, flux_adu = xy_px[kept], flux_adu[kept]
        if not len(xy_px):
            raise TooFewStars("the detector found no point source")
        order = np.argsort(-flux_adu, kind="stable")
        xy_px, flux = xy_px[order], flux_adu[order] * (1.0 if sensor is None else sensor.gain_e_per_adu)
        frame = source.frame(sigma_px)
        column, row = nearest_pixels(xy_px, frame.shape, 0).T
        noise_2 = np.square(frame.noise.at(row, column).astype(np.float64))
        flux_2, place_2 = source_variances(flux, noise_2, sigma_px, source.source_noise.per_unit)
        place_2 = place_2 if self.sigma_px is None else np.full(len(flux), self.sigma_px**2)
        return Detections(
            xy_px=xy_px, covariance_px2=place_2[:, None, None] * np.eye(2), flux_e=flux, flux_sigma_e=np.sqrt(flux_2),
            snr=flux / np.sqrt(flux_2), saturated=source.unusable[row, column], psf_sigma_px=sigma_px,
            image_e=source.image, dead=source.unusable, background=frame.background, noise=frame.noise, mask=mask,
        )  # fmt: skip


def source_variances(flux: Array, noise_2: Array | float, psf_sigma_px: float, photons: float) -> tuple[Array, Array]:
    """Variances (n,) of flux and position per axis [px^2] of a matched filter for sources of `flux` (n,).

    `psf_sigma_px` is the width of the PSF without the pixel [px], `noise_2` the variance of a pixel without a source,
    `photons` what one unit of light adds to it. Of a Gaussian that noise, photons and its own shape (a part of the
    signal) disturb; the sums are integrals.
    """
    width_2 = psf_sigma_px**2 + PIXEL_VARIANCE_PX2
    flux_2 = 4 * np.pi * width_2 * noise_2 + photons * flux + np.square(MODEL_ERROR * flux) / (2 * np.pi * width_2)
    place_2 = 8 * np.pi * width_2**2 * noise_2 / flux**2 + photons * width_2 / flux + MODEL_ERROR**2 / (2 * np.pi)
    return flux_2, place_2


def _checked(found: Any, size_px: tuple[int, int]) -> tuple[Array, Array]:
    """Positions (n, 2) and fluxes (n,) that a function returned. Raises ValueError that says what is wrong."""
    try:
        xy_px, flux = (np.asarray(one, dtype=np.float64) for one in found)
    except (TypeError, ValueError) as cause:
        raise ValueError(f"find() returned {type(found).__name__}: it must return (xy_px, flux_adu)") from cause
    xy_px = xy_px.reshape(-1, 2) if xy_px.size == 0 else xy_px
    if xy_px.ndim != 2 or xy_px.shape[1] != 2 or flux.shape != xy_px.shape[:1]:
        raise ValueError(f"find() returned arrays {xy_px.shape} and {flux.shape}: they must be (n, 2) and (n,)")
    outside = ~((xy_px >= -0.5) & (xy_px <= np.array(size_px) - 0.5)).all(axis=1)
    for bad, fault in ((outside, "outside the frame, or no numbers"), (~(flux > 0), "with a flux that is not above 0")):
        if bad.any():
            first = ", ".join(f"{v:g}" for v in (*xy_px[bad][0], flux[bad][0]))
            raise ValueError(f"find() returned {bad.sum()} of {len(flux)} sources {fault}; the first: {first}")
    return xy_px, flux
