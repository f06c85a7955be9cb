"""Point sources of an exposure: matched filter, PSF fits, and the rejection of what is not a star."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.camera import Camera
from startrack.detect.background import background_and_noise
from startrack.detect.crowded import fit_all
from startrack.detect.fit import PointFits
from startrack.detect.frame import Frame, LightNoise, electrons
from startrack.detect.judge import one_per_place, stars_among
from startrack.detect.peaks import find_peaks
from startrack.detect.widths import measured_width
from startrack.types import Bools, Detections, Exposure, Ints, TooFewStars

UNKNOWN_WIDTH_PX = 1.2  # first guess where the camera file does not tell
WIDTH_TOLERANCE = 0.12  # measured PSF differing by more than this fraction from the expected one is used instead
WIDTH_ROUNDS = 3  # a stamp of the wrong size measures a much wider PSF too small
NOTHING_SEEN = "no point source stands above the noise: was the lens cap on, or the exposure too short?"


@dataclass(frozen=True)
class Detector:
    """Detects point sources: Exposure -> Detections."""

    threshold_snr: float = 5.0  # against the background's noise; a little more for narrow PSFs
    max_candidates: int = 30000  # a frame with more peaks is noise, a bright day or a defect: the brightest are kept

    def __call__(self, exposure: Exposure, camera: Camera | None = None) -> Detections:
        """Point sources, brightest first; fluxes in electrons where the camera knows its gain, else in ADU.

        Raises TooFewStars (reason no_stars) where the frame holds no point source at all.
        """
        image, dead = electrons(exposure, camera)
        if image.min() == image.max():
            raise TooFewStars("the frame is flat: every pixel has the same value (lens cap, or a saturated day sky?)")
        background, noise = background_and_noise(image)
        known = camera.sensor.psf_sigma_px if camera is not None and camera.sensor is not None else None
        light_noise = LightNoise(per_unit=0.0 if known is None else 1.0)
        frame = Frame(image - background, noise, dead if dead.any() else None, light_noise)
        sigma = known or UNKNOWN_WIDTH_PX
        centres, fits = self._measure(frame, sigma)
        for _ in range(WIDTH_ROUNDS):
            measured = measured_width(frame, centres, fits, sigma)
            if measured is None or abs(np.log(measured / sigma)) < WIDTH_TOLERANCE:
                break
            sigma = measured
            centres, fits = self._measure(frame, sigma)
        good = stars_among(frame, centres, fits, sigma, self.threshold_snr)
        if not len(good):
            raise TooFewStars(NOTHING_SEEN)
        fits = fits.take(good[one_per_place(fits.xy_px[good], fits.flux[good], 1.2 * sigma)])
        fits = fits.take(np.argsort(-fits.flux, kind="stable"))
        return Detections(
            xy_px=fits.xy_px,
            covariance_px2=fits.covariance[:, :2, :2],
            flux_e=fits.flux,
            flux_sigma_e=np.sqrt(fits.covariance[:, 2, 2]),
            snr=fits.snr,
            saturated=_saturated(frame, fits),
            psf_sigma_px=sigma,
            background_e=background,
            noise_e=noise,
        )

    def _measure(self, frame: Frame, sigma: float) -> tuple[Ints, PointFits]:
        peaks = find_peaks(frame, sigma, self.max_candidates)
        if not len(peaks.centres):
            raise TooFewStars(NOTHING_SEEN)
        return peaks.centres, fit_all(frame, peaks, sigma)


def _saturated(frame: Frame, fits: PointFits) -> Bools:
    if frame.dead is None:
        return np.zeros(len(fits.flux), dtype=bool)
    height, width = frame.dead.shape
    column, row = np.rint(fits.xy_px).astype(int).T
    return np.asarray(frame.dead[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)])
