"""Point sources of an exposure: matched filter, PSF fits, and the rejection of other sources than stars."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from math import ceil
from typing import Any

import numpy as np

from startrack.camera import Camera
from startrack.core.limits import check_time
from startrack.core.types import Array, Bools, Detections, Exposure, Image, Mask, SmoothImage, TooFewStars
from startrack.detection.background import background_and_noise, block_side, smallest_step
from startrack.detection.classify import (
    NOMINAL_HEIGHT,
    detection_threshold,
    noise_skewness,
    peak_heights,
    refit_saturated,
    reject_wing_misfits,
    select_brightest_per_position,
    select_stars,
)
from startrack.detection.damage import ROUNDED, fill_masked, find_dead_parts, is_rounded
from startrack.detection.deblend import Fitted, fit_all, paint_sources
from startrack.detection.fit import PointFits, unbin_fits
from startrack.detection.frame import (
    MODEL_ERROR,
    Frame,
    SourceNoise,
    bin_frame,
    binning_factor,
    electrons,
    radius_for,
)
from startrack.detection.peaks import Peaks, find_peaks, nearest_pixels
from startrack.detection.psf_width import WIDTH_TOLERANCE, guess_psf_width, measure_psf_width
from startrack.detection.streaks import are_elongated, find_streaks
from startrack.exposure import combine_masks, touch_masked

UNKNOWN_WIDTH_PX = 1.2  # first guess where the camera file does not state the width
FIRST_PASS_LOWER = 1.1  # sigma of the filtered noise: threshold of the stars minus that of the candidates
WINGS_SIGMAS = 4.0  # radius of the area that a star covers
CROWDED_PART = 0.06  # of the frame, covered by stars: above it they are subtracted to measure the background again
NOTHING_SEEN = "no point source stands above the noise"
PIXEL_VARIANCE_PX2 = 1 / 12  # by which a pixel widens the PSF


@dataclass(frozen=True)
class _Candidates:
    """A frame, the same frame binned by `side`, and the candidates in it with their fits."""

    frame: Frame
    small: Frame
    side: int
    sigma: float  # of the PSF in the frame [px]
    fitted: Fitted


@dataclass(frozen=True)
class Detector:
    """Detects point sources: Exposure -> Detections."""

    threshold_snr: float = NOMINAL_HEIGHT  # for a PSF of 1.25 px; for other widths scaled to as many false stars
    max_candidates: int = 15000  # a frame with more peaks is noise, a bright day or a defect: the highest are kept
    psf_sigma_px: float | None = None  # used without measuring it; None: from the camera file and the frame

    def __call__(self, exposure: Exposure, camera: Camera | None = None) -> Detections:
        """Point sources of an `exposure`, brightest first; fluxes in electrons with the camera's gain, else in ADU.

        Raises TooFewStars (reason no_stars) if the frame has no point source, BadInput for a mask that cannot be used.
        """
        source, mask = prepare_frame(exposure, camera)
        known = camera.sensor.psf_sigma_px if camera is not None and camera.sensor is not None else None
        candidates = self._candidates(source, self.psf_sigma_px or known)
        frame, sigma, side = candidates.frame, candidates.sigma, candidates.side
        complete = partial(
            Detections, image_e=source.image, dead=source.unusable, mask=mask,
        )  # fmt: skip
        centres = side * candidates.fitted.stamps.centres + side // 2
        if are_elongated(frame, centres) and (streaks := find_streaks(frame)) is not None:
            if mask is not None:
                half_px = ceil(0.5 * streaks.length_px + WINGS_SIGMAS * streaks.width_px)
                streaks = streaks.take(~touch_masked(mask.masked, streaks.xy_px, half_px))
            return complete(
                xy_px=streaks.xy_px, covariance_px2=streaks.covariance_px2, flux_e=streaks.flux,
                flux_sigma_e=streaks.flux_sigma, snr=streaks.flux / streaks.flux_sigma,
                saturated=np.zeros(len(streaks.flux), dtype=bool), psf_sigma_px=streaks.psf_sigma_px,
                background=frame.background, noise=frame.noise,
            )  # fmt: skip
        stars = self._select_stars(frame, candidates.fitted, side, sigma)
        covered_px = len(stars.flux) * np.pi * np.square(WINGS_SIGMAS * sigma)  # overlaps counted twice
        if side > 1 or covered_px > CROWDED_PART * source.image.size:
            frame, stars = self._detect_again(source, candidates, unbin_fits(stars, side))
        if not len(stars.flux):
            raise _nothing_seen(frame)
        saturated = np.zeros(len(stars.flux), dtype=bool)
        if frame.dead is not None:
            column, row = nearest_pixels(stars.xy_px, frame.shape, 0).T
            saturated = frame.dead[row, column]
        return complete(
            xy_px=stars.xy_px, covariance_px2=stars.covariance[:, :2, :2], flux_e=stars.flux,
            flux_sigma_e=np.sqrt(stars.covariance[:, 2, 2]), snr=stars.snr, saturated=saturated, psf_sigma_px=sigma,
            background=frame.background, noise=frame.noise,
        )  # fmt: skip

    def _candidates(self, source: FrameSource, expected: float | None) -> _Candidates:
        """Candidates and their fits, with the PSF width measured in the frame."""
        if expected is None:
            return self._candidates_at(source, guess_psf_width(source.frame, UNKNOWN_WIDTH_PX))
        found = self._candidates_at(source, expected)
        if self.psf_sigma_px:
            return found
        stamps, fits, side = found.fitted.stamps, found.fitted.fits, found.side
        measured = measure_psf_width(found.small, stamps.centres, fits, found.sigma / side)
        if measured is None or abs(np.log(measured * side / expected)) < WIDTH_TOLERANCE:
            return found
        return self._candidates_at(source, guess_psf_width(source.frame, measured * side))

    def _candidates_at(self, source: FrameSource, sigma: float) -> _Candidates:
        """Candidates and their fits; where the PSF is wide, in the binned frame."""
        side, frame = binning_factor(sigma), source.frame(sigma)
        check_time()
        small = bin_frame(frame, side)
        peaks = self._find_peaks(frame, small, side, sigma)
        return _Candidates(frame, small, side, sigma, fit_all(small, peaks, sigma / side))

    def _detect_again(self, source: FrameSource, candidates: _Candidates, stars: PointFits) -> tuple[Frame, PointFits]:
        """The frame and its stars; known stars are subtracted before the background and faint stars are measured."""
        side, sigma = candidates.side, candidates.sigma
        frame = source.frame(sigma, paint_sources(stars, sigma, source.image.shape))
        frame = replace(frame, source_noise=candidates.fitted.source_noise)
        check_time()
        positions = (stars.xy_px - 0.5 * (side - 1)) / side
        peaks = self._find_peaks(frame, bin_frame(frame, side), side, sigma, known=positions)
        if side > 1:
            start = side * peaks.start_xy_px + 0.5 * (side - 1)
            pixels = nearest_pixels(start, frame.shape, radius_for(sigma))
            peaks = Peaks(pixels, start, peaks.surround / side**2, peaks.own_part)
        return frame, self._select_stars(frame, fit_all(frame, peaks, sigma, known=stars), 1, sigma)

    def _find_peaks(self, frame: Frame, small: Frame, side: int, sigma: float, known: Array | None = None) -> Peaks:
        """Candidates in the binned frame; their threshold is lower: the filtered image is sampled at pixels only."""
        lowest = detection_threshold(self.threshold_snr, sigma, noise_skewness(frame)) - FIRST_PASS_LOWER
        peaks = find_peaks(small, sigma / side, lowest, self.max_candidates, known)
        if not len(peaks.centres):
            raise _nothing_seen(frame)
        return peaks

    def _select_stars(self, frame: Frame, fitted: Fitted, side: int, sigma: float) -> PointFits:
        """The point sources among the candidates of the binned frame, brightest first."""
        fitted, width_px = refit_saturated(fitted, sigma / side)
        fits = fitted.fits
        threshold = detection_threshold(self.threshold_snr, sigma / side, noise_skewness(frame) / side)
        good = select_stars(fitted, width_px, threshold)
        if frame.masked is not None:
            xy_px = side * fits.xy_px[good] + 0.5 * (side - 1)
            good = good[~touch_masked(frame.masked, xy_px, radius_for(sigma))]
        good = good[select_brightest_per_position(fits.xy_px[good], fits.flux[good], 1.2 * sigma / side)]
        stars = fits.take(good[np.argsort(-fits.flux[good], kind="stable")])
        clear = reject_wing_misfits(stars.xy_px, stars.flux, peak_heights(stars), sigma / side, threshold)
        return stars.take(np.flatnonzero(clear))


def prepare_frame(exposure: Exposure, camera: Camera | None) -> tuple[FrameSource, Mask | None]:
    """The image of an `exposure` in electrons, or ADU, with its unusable pixels, and the mask of camera and image.

    Raises TooFewStars (reason no_stars) for a flat frame, BadInput for a mask that cannot be used.
    """
    image, dead = electrons(exposure, camera)
    mask = combine_masks(exposure.mask, None if camera is None else camera.mask, exposure.size_px, exposure.correction)
    parts = find_dead_parts(exposure.recorded_adu)
    if parts is not None:
        mask = mask or Mask(masked=np.zeros_like(parts), sha256="")
        mask = replace(mask, masked=mask.masked | parts, dead_part=float(parts.mean()))
    if mask is not None:
        image, dead = fill_masked(image, mask.masked), dead & ~mask.masked
    if float(image[0, 0]) == float(image[-1, -1]) == float(image[::64, ::64].max()) and not np.ptp(image):
        raise TooFewStars("the frame is flat: every pixel has the same value")
    sensor = None if camera is None else camera.sensor
    # Dark frame and flat field do not undo the rounding of the counts.
    gain = 1.0 if sensor is None else sensor.gain_e_per_adu
    quantum = smallest_step(image) if exposure.correction is None else gain * smallest_step(exposure.recorded_adu)
    return FrameSource(
        image, quantum, dead if dead.any() else None, SourceNoise(per_unit=0.0 if sensor is None else 1.0),
        None if mask is None else mask.masked,
    ), mask  # fmt: skip


class FrameSource:
    """An image with its unusable pixels; backgrounds are computed once for each block size."""

    def __init__(
        self, image: Image, quantum: float, dead: Bools | None, source_noise: SourceNoise, masked: Bools | None
    ) -> None:
        self.image, self.quantum, self.dead, self.source_noise, self.masked = image, quantum, dead, source_noise, masked
        self._kept: dict[int, tuple[SmoothImage, SmoothImage]] = {}

    @property
    def unusable(self) -> Bools:
        """Saturated and masked pixels (H, W)."""
        found = np.zeros(self.image.shape, dtype=bool) if self.dead is None else self.dead
        return found if self.masked is None else found | self.masked

    def frame(self, sigma: float, found: Image | None = None) -> Frame:
        """The prepared frame; stars in `found` are excluded from background and noise."""
        side = block_side(sigma)
        if found is None and side not in self._kept:
            self._kept[side] = background_and_noise(self.image, self.quantum, sigma)
        maps = self._kept[side] if found is None else background_and_noise(self.image - found, self.quantum, sigma)
        return Frame(self.image, *maps, self.dead, self.source_noise, self.masked, found)


def _nothing_seen(frame: Frame) -> TooFewStars:
    """The refusal of a frame without point sources."""
    is_coarse = is_rounded(frame.noise.whole(), smallest_step(frame.image))
    return TooFewStars(NOTHING_SEEN, advice=ROUNDED if is_coarse else "")


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
