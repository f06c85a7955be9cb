"""Point sources of an exposure: matched filter, PSF fits, and the rejection of what is not a star."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.camera import Camera
from startrack.detect.background import background_and_noise, quantum_of
from startrack.detect.crowded import Fitted, fit_all, painted
from startrack.detect.fit import PointFits
from startrack.detect.frame import Frame, Image, LightNoise, electrons
from startrack.detect.judge import one_per_place, stars_among, threshold_for
from startrack.detect.peaks import find_peaks
from startrack.detect.streaks import Streaks, drawn_out, find_streaks
from startrack.detect.widths import measured_width
from startrack.types import Bools, Detections, Exposure, TooFewStars

UNKNOWN_WIDTH_PX = 1.2  # first guess where the camera file does not tell
WIDTH_TOLERANCE = 0.12  # measured PSF differing by more than this fraction from the expected one is used instead
WIDTH_ROUNDS = 3  # a stamp of the wrong size measures a much wider PSF too small
FIRST_PASS_LOWER = 1.1
WINGS_SIGMAS = 4.0
CROWDED_PART = 0.06  # covered by stars: from here up they are taken away before the background is measured again
NOTHING_SEEN = "no point source stands above the noise: was the lens cap on, or the exposure too short?"


@dataclass(frozen=True)
class Detector:
    """Detects point sources: Exposure -> Detections."""

    threshold_snr: float = 5.42  # for a PSF of 1.25 px; for others what gives about as few false stars
    max_candidates: int = 15000  # a frame with more peaks is noise, a bright day or a defect: the highest are kept
    psf_sigma_px: float | None = None  # taken as it is, whatever camera file and frame say of the PSF's width

    def __call__(self, exposure: Exposure, camera: Camera | None = None) -> Detections:
        """Point sources, brightest first; fluxes in electrons where the camera knows its gain, else in ADU.

        Raises TooFewStars (reason no_stars) where the frame holds no point source at all.
        """
        image, dead = electrons(exposure, camera)
        if _is_flat(image):
            raise TooFewStars("the frame is flat: every pixel has the same value (lens cap, or a saturated day sky?)")
        known = camera.sensor.psf_sigma_px if camera is not None and camera.sensor is not None else None
        light_noise = LightNoise(per_unit=0.0 if known is None else 1.0)
        frame, fitted, sigma = self._measured(image, dead, self.psf_sigma_px or known or UNKNOWN_WIDTH_PX, light_noise)
        if drawn_out(frame, fitted.stamps.centres) and (streaks := find_streaks(frame)) is not None:
            return _of_streaks(frame, streaks)
        stars = self._stars(fitted, sigma)
        if _covered(stars, sigma, frame.shape) > CROWDED_PART:
            frame = _frame(image, frame.dead, sigma, light_noise, painted(stars, sigma, frame.shape))
            peaks = find_peaks(frame, sigma, self._first_pass(sigma), self.max_candidates, known=stars.xy_px)
            stars = self._stars(fit_all(frame, peaks, sigma), sigma)
        if not len(stars.flux):
            raise TooFewStars(NOTHING_SEEN)
        return Detections(
            xy_px=stars.xy_px,
            covariance_px2=stars.covariance[:, :2, :2],
            flux_e=stars.flux,
            flux_sigma_e=np.sqrt(stars.covariance[:, 2, 2]),
            snr=stars.snr,
            saturated=_saturated(frame, stars),
            psf_sigma_px=sigma,
            background_e=frame.background,
            noise_e=frame.noise,
        )

    def _measured(
        self, image: Image, dead: Bools, sigma: float, light_noise: LightNoise
    ) -> tuple[Frame, Fitted, float]:
        """Frame, candidates and their fits, with the PSF's width as the frame shows it."""
        usable = dead if dead.any() else None
        for last in (*[False] * (0 if self.psf_sigma_px else WIDTH_ROUNDS), True):
            frame = _frame(image, usable, sigma, light_noise)
            peaks = find_peaks(frame, sigma, self._first_pass(sigma), self.max_candidates)
            if not len(peaks.centres):
                raise TooFewStars(NOTHING_SEEN)
            fitted = fit_all(frame, peaks, sigma)
            measured = None if last else measured_width(frame, peaks.centres, fitted.fits, sigma)
            if measured is None or abs(np.log(measured / sigma)) < WIDTH_TOLERANCE:
                break
            sigma = measured
        return frame, fitted, sigma

    def _first_pass(self, sigma: float) -> float:
        """A star between pixels shows less in the filtered image than its fit does."""
        return threshold_for(self.threshold_snr, sigma) - FIRST_PASS_LOWER

    def _stars(self, fitted: Fitted, sigma: float) -> PointFits:
        fits = fitted.fits
        good = stars_among(fitted, sigma, self.threshold_snr)
        good = good[one_per_place(fits.xy_px[good], fits.flux[good], 1.2 * sigma)]
        return fits.take(good[np.argsort(-fits.flux[good], kind="stable")])


def _of_streaks(frame: Frame, streaks: Streaks) -> Detections:
    """The stars of a frame taken while the camera turned; the PSF's width is that of the whole streak."""
    return Detections(
        xy_px=streaks.xy_px,
        covariance_px2=streaks.covariance_px2,
        flux_e=streaks.flux,
        flux_sigma_e=streaks.flux_sigma,
        snr=streaks.flux / streaks.flux_sigma,
        saturated=np.zeros(len(streaks.flux), dtype=bool),
        psf_sigma_px=float(np.hypot(streaks.width_px, streaks.length_px / np.sqrt(12.0))),
        background_e=frame.background,
        noise_e=frame.noise,
    )


def _is_flat(image: Image) -> bool:
    return float(image[0, 0]) == float(image[-1, -1]) == float(image[::64, ::64].max()) and not np.ptp(image)


def _frame(
    image: Image, dead: Bools | None, sigma: float, light_noise: LightNoise, found: Image | None = None
) -> Frame:
    """The image prepared; background and noise are those of what is behind the stars already `found`."""
    behind = image if found is None else image - found
    background, noise = background_and_noise(behind, quantum_of(image), sigma)
    return Frame(image, background, noise, dead, light_noise, found)


def _covered(stars: PointFits, sigma: float, shape: tuple[int, int]) -> float:
    """Part of the frame that the wings of its stars cover, overlaps counted twice."""
    return float(len(stars.flux) * np.pi * np.square(WINGS_SIGMAS * sigma) / (shape[0] * shape[1]))


def _saturated(frame: Frame, stars: PointFits) -> Bools:
    if frame.dead is None:
        return np.zeros(len(stars.flux), dtype=bool)
    height, width = frame.dead.shape
    column, row = np.rint(stars.xy_px).astype(int).T
    return np.asarray(frame.dead[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)])
