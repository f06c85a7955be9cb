"""Point sources of an exposure: matched filter, PSF fits, and the rejection of what is not a star."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.camera import Camera
from startrack.detection.background import background_and_noise, block_side, quantum_of
from startrack.detection.binned import any_dead, binned, in_pixels, peaks_in_pixels, pixels_together
from startrack.detection.classify import height_of, not_beside, one_per_place, skewness_of, stars_among, threshold_for
from startrack.detection.deblend import Fitted, fit_all, painted
from startrack.detection.fit import ROUNDS_AGAIN, PointFits, Stamps, fit_points
from startrack.detection.frame import Frame, Image, LightNoise, electrons, radius_for
from startrack.detection.peaks import Peaks, bright_pixels, find_peaks
from startrack.detection.psf_width import BRIGHT_SNR, measured_width
from startrack.detection.saturated import wider_where_clipped
from startrack.detection.streaks import Streaks, drawn_out, find_streaks
from startrack.types import Array, Bools, Detections, Exposure, Ints, TooFewStars

UNKNOWN_WIDTH_PX = 1.2  # first guess where the camera file does not tell
WIDTH_TOLERANCE = 0.12  # measured PSF differing by more than this fraction from the expected one is used instead
BRIGHT_PIXEL_SIGMAS, BRIGHT_PIXELS, ENOUGH_PIXELS = 8.0, 64, 30
LEAST_BESIDE, LEAST_FALL, MOST_FALL = 0.02, 0.05, 3.5  # light beside a peak; its fall for 4.5 px and 0.45 px
WIDTH_ROUNDS = 4  # a stamp of the wrong size measures a much wider PSF too small
FIRST_PASS_LOWER = 1.1
WINGS_SIGMAS = 4.0
CROWDED_PART = 0.06  # covered by stars: from here up they are taken away before the background is measured again
NOTHING_SEEN = "no point source stands above the noise: was the lens cap on, or the exposure too short?"


@dataclass(frozen=True)
class _Look:
    """A frame, the same with its pixels added together `side` by `side`, and the candidates there with their fits."""

    frame: Frame
    small: Frame
    side: int
    sigma: float  # of the PSF in the frame [px]
    fitted: Fitted

    @property
    def centres(self) -> Ints:
        """Pixels (n, 2) of the candidates in the frame."""
        return self.side * self.fitted.stamps.centres + self.side // 2


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
        look = self._looked(_Behind(image, any_dead(dead), light_noise), self.psf_sigma_px or known)
        frame, sigma = look.frame, look.sigma
        if drawn_out(frame, look.centres) and (streaks := find_streaks(frame)) is not None:
            return _of_streaks(frame, streaks)
        stars = self._stars(frame, look.fitted, look.side, sigma)
        if look.side > 1 or _covered(stars, sigma, frame.shape) > CROWDED_PART:
            frame, stars = self._again(look, in_pixels(stars, look.side))
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

    def _looked(self, behind: _Behind, expected: float | None) -> _Look:
        """Candidates and their fits, with the PSF's width as the frame shows it."""
        if expected is None:
            return self._look(behind, _width_of_brightest(behind, UNKNOWN_WIDTH_PX))
        look = self._look(behind, expected)
        if self.psf_sigma_px:
            return look
        measured = measured_width(look.small, look.fitted.stamps.centres, look.fitted.fits, look.sigma / look.side)
        if measured is None or abs(np.log(measured * look.side / expected)) < WIDTH_TOLERANCE:
            return look
        return self._look(behind, _width_of_brightest(behind, measured * look.side))

    def _look(self, behind: _Behind, sigma: float) -> _Look:
        """Candidates and their fits; where the PSF is wide, in the frame whose pixels are added together."""
        side = pixels_together(sigma)
        frame = behind.frame(sigma)
        small = binned(frame, side)
        peaks = self._peaks(frame, small, side, sigma)
        if not len(peaks.centres):
            raise TooFewStars(NOTHING_SEEN)
        return _Look(frame, small, side, sigma, fit_all(small, peaks, sigma / side))

    def _again(self, look: _Look, stars: PointFits) -> tuple[Frame, PointFits]:
        """The frame and its stars, those known taken away before background and faint ones are measured."""
        side, sigma, frame = look.side, look.sigma, look.frame
        frame = _Behind(frame.image, frame.dead, look.fitted.light_noise).frame(
            sigma, painted(stars, sigma, frame.shape)
        )
        places = (stars.xy_px - 0.5 * (side - 1)) / side
        peaks = self._peaks(frame, binned(frame, side), side, sigma, known=places)
        peaks = peaks_in_pixels(peaks, side, frame.shape, radius_for(sigma))
        if not len(peaks.centres):
            raise TooFewStars(NOTHING_SEEN)
        return frame, self._stars(frame, fit_all(frame, peaks, sigma, known=stars), 1, sigma)

    def _peaks(self, frame: Frame, small: Frame, side: int, sigma: float, known: Array | None = None) -> Peaks:
        """Candidates in a frame's small one: a star between pixels shows less in the filtered image than its fit."""
        lowest = threshold_for(self.threshold_snr, sigma, skewness_of(frame)) - FIRST_PASS_LOWER
        return find_peaks(small, sigma / side, lowest, self.max_candidates, known)

    def _stars(self, frame: Frame, fitted: Fitted, side: int, sigma: float) -> PointFits:
        """The point sources among the candidates, in a frame's small one, brightest first."""
        fitted, width_px = wider_where_clipped(fitted, sigma / side)
        fits = fitted.fits
        threshold = threshold_for(self.threshold_snr, sigma / side, skewness_of(frame) / side)
        good = stars_among(fitted, width_px, threshold)
        good = good[one_per_place(fits.xy_px[good], fits.flux[good], 1.2 * sigma / side)]
        stars = fits.take(good[np.argsort(-fits.flux[good], kind="stable")])
        clear = not_beside(stars.xy_px, stars.flux, height_of(stars), sigma / side, threshold)
        return stars.take(np.flatnonzero(clear))


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


class _Behind:
    """An image with its unusable pixels; backgrounds are worked out once for each size of their blocks."""

    def __init__(self, image: Image, dead: Bools | None, light_noise: LightNoise) -> None:
        self.image, self.dead, self.light_noise = image, dead, light_noise
        self.quantum = quantum_of(image)
        self._kept: dict[int, tuple[Image, Image]] = {}

    def frame(self, sigma: float, found: Image | None = None) -> Frame:
        """The image prepared; background and noise are those of what is behind the stars already `found`."""
        if found is not None:
            maps = background_and_noise(self.image - found, self.quantum, sigma)
            return Frame(self.image, *maps, self.dead, self.light_noise, found)
        side = block_side(sigma)
        if side not in self._kept:
            self._kept[side] = background_and_noise(self.image, self.quantum, sigma)
        return Frame(self.image, *self._kept[side], self.dead, self.light_noise)


def _width_of_brightest(behind: _Behind, sigma: float) -> float:
    """PSF sigma [px] that the frame's brightest pixels show, from a first guess, which is kept if they do not tell."""
    frame = behind.frame(sigma)
    pixels = bright_pixels(frame, BRIGHT_PIXEL_SIGMAS, BRIGHT_PIXELS, 1)
    if len(pixels) < ENOUGH_PIXELS:  # too few stand out by one pixel
        found = find_peaks(frame, sigma, BRIGHT_SNR, BRIGHT_PIXELS).centres
        pixels = found if len(found) > len(pixels) else pixels
    elif (guess := _width_of_pixels(frame, pixels)) is not None:
        sigma = guess
    for _ in range(WIDTH_ROUNDS):
        radius = radius_for(sigma)
        last = np.array([frame.shape[1], frame.shape[0]]) - 1
        centres = pixels[((pixels >= radius) & (pixels <= last - radius)).all(axis=1)]
        if not len(centres):
            break
        data, variance = frame.data(centres, radius), frame.variance(centres, radius)
        stamps = Stamps(data, variance, frame.usable(centres, radius), centres, np.zeros(len(centres)))
        fits = fit_points(stamps, centres.astype(np.float64), sigma, frame.light_noise, 0.0, ROUNDS_AGAIN)
        measured = measured_width(frame, centres, fits, sigma)
        if measured is None:
            break
        settled = abs(np.log(measured / sigma)) < WIDTH_TOLERANCE
        sigma = measured
        if settled:
            break
    return sigma


def _width_of_pixels(frame: Frame, pixels: Ints) -> float | None:
    """About the PSF sigma [px] of sources whose brightest pixels (n, 2) lie off the border; None where they are odd.

    Of a Gaussian of variance s^2 the values left and right of a pixel have the product of its square and exp(-1 / s^2),
    wherever the middle is.
    """
    light = np.maximum(frame.data(pixels, 1), 0.0)
    peak = np.maximum(light[:, 1, 1], 1e-9)
    beside = np.stack([light[:, 1, 0], light[:, 1, 2], light[:, 0, 1], light[:, 2, 1]], axis=1) / peak[:, None]
    falls = -0.5 * float(np.median(np.log(np.maximum(beside, LEAST_BESIDE)).sum(axis=1)))
    if not LEAST_FALL < falls < MOST_FALL:
        return None
    return float(np.sqrt(1.0 / falls - 1.0 / 12.0))


def _covered(stars: PointFits, sigma: float, shape: tuple[int, int]) -> float:
    """Part of the frame that the wings of its stars cover, overlaps counted twice."""
    return float(len(stars.flux) * np.pi * np.square(WINGS_SIGMAS * sigma) / (shape[0] * shape[1]))


def _saturated(frame: Frame, stars: PointFits) -> Bools:
    if frame.dead is None:
        return np.zeros(len(stars.flux), dtype=bool)
    height, width = frame.dead.shape
    column, row = np.rint(stars.xy_px).astype(int).T
    return np.asarray(frame.dead[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)])
