"""Point sources of an exposure: matched filter, PSF fits, and the rejection of what is not a star."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.camera import Camera
from startrack.detect.background import background_and_noise, local_level
from startrack.detect.fit import MODEL_ERROR, PointFits, fit_points, fit_widths, radius_for, stamps
from startrack.detect.impostors import edge_chi2
from startrack.psf import filter_kernel, pixel_profile
from startrack.types import Bools, Detections, Exposure, Ints, TooFewStars

Image = NDArray[np.float32]
FIRST_PASS_SNR = 4.3  # below the final threshold: a star between pixels shows up to 15 % less in the filtered image
NARROW_PX = 1.25
OWN_LEVEL_PART = 0.8  # of the threshold that a source must reach by its own stamp alone, everywhere
UNEVEN_SIGMA = 2.5  # difference of the stamp's level and that of its surroundings where these are not to be trusted
EDGE_MARGIN = 20.0  # chi^2 by which an edge must explain a stamp better: noise alone gives faint stars less
CROWDED_ROUNDS = 3  # of subtracting neighbours and fitting again
NEIGHBOUR_SIGMA = 0.1  # neighbours' light above this part of a pixel's noise is taken away
NEIGHBOUR_ERROR = 0.1  # of it is not known: neighbours' fits, and the PSF's wings
BAD_FIT_CHI2_PER_DOF = 4.0
ROUGH_PSF_MISFIT = 0.1  # from here up the frame's own stars, not the Gaussian, say what a star looks like
ROUGH_PSF_SPREAD = 2.0  # times the typical misfit that a star of such a frame may have
BRIGHT_SNR = 12.0  # sources that say what the frame's PSF is
FEWEST_BRIGHT = 8
MOST_BRIGHT = 300
WIDTHS_PX = np.geomspace(0.3, 8.0, 36)
UNKNOWN_WIDTH_PX = 1.2  # first guess where the camera file does not tell
WIDTH_TOLERANCE = 0.12  # measured PSF differing by more than this fraction from the expected one is used instead
WIDTH_ROUNDS = 3  # a stamp of the wrong size measures a much wider PSF too small
SATURATED_FRACTION = 0.98
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
        background, noise = background_and_noise(image)
        if not np.ptp(image):
            raise TooFewStars("the frame is flat: every pixel has the same value (lens cap, or a saturated day sky?)")
        frame = _Frame(image - background, noise, dead, shot=camera is not None and camera.sensor is not None)
        known = camera.sensor.psf_sigma_px if camera is not None and camera.sensor is not None else None
        sigma = known or UNKNOWN_WIDTH_PX
        centres, fits = self._measure(frame, sigma)
        for _ in range(WIDTH_ROUNDS):
            measured = _measured_width(frame, centres, fits, sigma)
            if measured is None or abs(np.log(measured / sigma)) < WIDTH_TOLERANCE:
                break
            sigma = measured
            centres, fits = self._measure(frame, sigma)
        good = _is_star(fits, _threshold(self.threshold_snr, sigma), *_likeness(frame, centres, fits, sigma))
        if not good.any():
            raise TooFewStars(NOTHING_SEEN)
        return _detections(frame, fits, good, sigma, background, noise)

    def _measure(self, frame: _Frame, sigma: float) -> tuple[Ints, PointFits]:
        level = local_level(frame.residual, frame.noise, 2 * (4 * radius_for(sigma) // 2) + 1)
        centres = _peaks(frame, level, sigma, self.max_candidates)
        if not len(centres):
            raise TooFewStars(NOTHING_SEEN)
        return centres, _fit_all(frame, centres, level, sigma)


@dataclass(frozen=True)
class _Frame:
    residual: Image  # background-subtracted
    noise: Image
    dead: NDArray[np.bool_]  # saturated or outside the image circle: no weight in fits
    shot: bool


def electrons(exposure: Exposure, camera: Camera | None) -> tuple[Image, NDArray[np.bool_]]:
    """The exposure in electrons above bias (ADU where the gain is unknown), and the mask of saturated pixels."""
    pixels = exposure.pixels_adu
    ceiling = exposure.saturation_adu or np.inf
    if camera is None or camera.sensor is None:
        return pixels, pixels >= SATURATED_FRACTION * ceiling
    sensor = camera.sensor
    saturated = pixels >= SATURATED_FRACTION * min(ceiling, sensor.saturation_adu)
    return (pixels - np.float32(sensor.bias_adu)) * np.float32(sensor.gain_e_per_adu), saturated


def _peaks(frame: _Frame, level: Image, sigma: float, most: int) -> Ints:
    """Integer pixels (n, 2) (x, y) of the local maxima of the matched-filter SNR, brightest first."""
    kernel = filter_kernel(sigma)
    filtered = cv2.sepFilter2D(frame.residual - level, -1, kernel, kernel, borderType=cv2.BORDER_REFLECT)
    snr = filtered / (frame.noise * np.float32(np.sum(kernel**2)))
    top = cv2.dilate(snr, np.ones((3, 3), np.uint8))
    candidate = (snr >= top) & (snr > FIRST_PASS_SNR)
    margin = radius_for(sigma)
    candidate[:margin] = candidate[-margin:] = False
    candidate[:, :margin] = candidate[:, -margin:] = False
    candidate &= ~frame.dead
    rows, columns = np.nonzero(candidate)
    order = np.argsort(-snr[rows, columns], kind="stable")[:most]
    peaks = np.stack([columns[order], rows[order]], axis=1).astype(np.int64)
    return np.concatenate([_saturated_blobs(frame.dead, margin), peaks])


def _saturated_blobs(dead: NDArray[np.bool_], margin: int) -> Ints:
    """Middle pixels (n, 2) of the saturated blobs: bright stars whose own peak is a plateau."""
    if not dead.any():
        return np.zeros((0, 2), dtype=np.int64)
    count, _, stats, centroids = cv2.connectedComponentsWithStats(dead.astype(np.uint8))
    height, width = dead.shape
    middle = np.rint(centroids[1:count]).astype(np.int64)
    inside = (middle >= margin).all(axis=1) & (middle[:, 0] < width - margin) & (middle[:, 1] < height - margin)
    compact = stats[1:count, cv2.CC_STAT_AREA] <= (2 * margin + 1) ** 2
    return middle[inside & compact]


def _fit_all(frame: _Frame, centres: Ints, level: Image, sigma: float) -> PointFits:
    """Fits of all candidates, each with its neighbours' light subtracted."""
    radius = radius_for(sigma)
    variance = np.square(stamps(frame.noise, centres, radius))
    usable = ~stamps(frame.dead, centres, radius).astype(bool)
    data = stamps(frame.residual, centres, radius)
    surround = level[centres[:, 1], centres[:, 0]].astype(np.float64)
    fits = fit_points(data, variance, usable, centres, centres.astype(np.float64), surround, sigma, frame.shot)
    for _ in range(CROWDED_ROUNDS):
        others = _neighbours_light(centres, fits, sigma, radius)
        crowded = np.flatnonzero((others > NEIGHBOUR_SIGMA * np.sqrt(variance)).any(axis=(1, 2)))
        if not len(crowded):
            break
        others = others[crowded]
        again = fit_points(
            data[crowded] - others,
            variance[crowded] + np.square(NEIGHBOUR_ERROR * others),
            usable[crowded],
            centres[crowded],
            fits.xy_px[crowded],
            surround[crowded],
            sigma,
            frame.shot,
        )
        fits = fits.replaced(crowded, again)
    return fits


def _neighbours_light(centres: Ints, fits: PointFits, sigma: float, radius: int) -> NDArray[np.float64]:
    """Light (n, s, s) that the other sources put into each one's stamp."""
    from scipy.spatial import cKDTree

    pairs = cKDTree(centres).query_pairs(1.5 * radius + 3.0 * sigma, output_type="ndarray")
    star, other = np.concatenate([pairs, pairs[:, ::-1]]).T
    offset = fits.xy_px[other] - centres[star]
    px, _ = pixel_profile(offset[:, 0], sigma, radius)
    py, _ = pixel_profile(offset[:, 1], sigma, radius)
    light = np.zeros((len(centres), 2 * radius + 1, 2 * radius + 1))
    np.add.at(light, star, np.maximum(fits.flux[other], 0.0)[:, None, None] * py[:, :, None] * px[:, None, :])
    return light


def _threshold(threshold_snr: float, sigma_px: float) -> float:
    """Significance that gives a narrow PSF no more false peaks than one of NARROW_PX.

    Noise has about sigma^-4 as many peaks above a given height (measured: 7, 2.5 and 0.25 above 5 in 4 Mpx at sigma
    0.7, 1.0 and 1.5 px), and their number falls as exp(-height^2 / 2).
    """
    return float(np.sqrt(threshold_snr**2 + max(8 * np.log(NARROW_PX / sigma_px), 0.0)))


def _is_star(
    fits: PointFits, threshold_snr: float, misfit: NDArray[np.float64], edge: NDArray[np.float64]
) -> Bools:
    """Sources that stand above the threshold, look like the PSF, and not rather like a hot pixel, an edge or a track.

    Where the bright sources of the frame all differ from the Gaussian (trails, coma, a real lens), no bright star would
    pass by its chi^2; there a source passes whose `misfit` (n,) is like theirs.
    """
    point = (fits.chi2 < fits.chi2_pixel) & (fits.chi2 < edge + EDGE_MARGIN)
    by_itself = fits.flux / np.sqrt(fits.covariance[:, 2, 2])
    bright = point & (by_itself > BRIGHT_SNR)
    typical = float(np.median(misfit[bright])) if np.count_nonzero(bright) >= FEWEST_BRIGHT else 0.0
    like_the_others = misfit < (ROUGH_PSF_SPREAD * typical if typical > ROUGH_PSF_MISFIT else 0.0)
    # On a slope or at the skyline the surroundings do not tell the level; there the stamp must tell by itself.
    level_sigma = np.sqrt(fits.covariance[:, 3, 3])
    even = np.abs(fits.level - fits.surround) < UNEVEN_SIGMA * level_sigma
    stands_out = (by_itself >= threshold_snr) | (
        even & (fits.significance >= threshold_snr) & (by_itself >= OWN_LEVEL_PART * threshold_snr)
    )
    return (
        stands_out
        & ((fits.chi2 < BAD_FIT_CHI2_PER_DOF * fits.dof) | like_the_others)
        & point
        & (np.sqrt(fits.covariance[:, 0, 0] + fits.covariance[:, 1, 1]) < 2.0)
    )


def _likeness(
    frame: _Frame, centres: Ints, fits: PointFits, sigma: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How far the sources (n) are from the Gaussian PSF, and their chi^2 as straight edges or lines instead.

    The first is the root of the squared residual beyond the noise over the squared light: 0 for a perfect star, about
    0.6 for a single bright pixel.
    """
    radius = radius_for(sigma)
    data, variance = stamps(frame.residual, centres, radius), np.square(stamps(frame.noise, centres, radius))
    usable = ~stamps(frame.dead, centres, radius).astype(bool)
    light = _own_light(centres, fits, sigma, radius)
    noise = variance + (light if frame.shot else 0.0)
    excess = usable * (np.square(data - light - fits.level[:, None, None]) - noise)
    total = np.sum(usable * np.square(light), axis=(1, 2))
    misfit = np.sqrt(np.maximum(excess.sum(axis=(1, 2)), 0.0) / np.maximum(total, 1e-12))
    return misfit, edge_chi2(data, usable / (noise + np.square(MODEL_ERROR * light)))


def _own_light(centres: Ints, fits: PointFits, sigma: float, radius: int) -> NDArray[np.float64]:
    offset = fits.xy_px - centres
    px, _ = pixel_profile(offset[:, 0], sigma, radius)
    py, _ = pixel_profile(offset[:, 1], sigma, radius)
    return np.maximum(fits.flux, 0.0)[:, None, None] * py[:, :, None] * px[:, None, :]


def _measured_width(frame: _Frame, centres: Ints, fits: PointFits, sigma: float) -> float | None:
    """Typical PSF sigma [px] of the bright sources; None where there are too few to tell."""
    radius = radius_for(sigma)
    whole = ~stamps(frame.dead, centres, radius).any(axis=(1, 2))
    bright = np.flatnonzero((fits.snr > BRIGHT_SNR) & whole)[:MOST_BRIGHT]
    if len(bright) < FEWEST_BRIGHT:
        return None
    pixels = centres[bright]
    data, noise = stamps(frame.residual, pixels, radius), stamps(frame.noise, pixels, radius)
    variance = np.square(noise) + (np.maximum(data, 0.0) if frame.shot else 0.0)
    widths = fit_widths(data, variance, np.ones(data.shape, bool), fits.take(bright), pixels, WIDTHS_PX)
    wider_than_a_pixel = widths[widths > 0.45]  # hot pixels fit the narrowest profile
    if len(wider_than_a_pixel) < FEWEST_BRIGHT:
        return None
    return float(np.median(wider_than_a_pixel))


def _detections(
    frame: _Frame, fits: PointFits, good: Bools, sigma: float, background: Image, noise: Image
) -> Detections:
    flux_sigma = np.sqrt(fits.covariance[:, 2, 2])
    xy = np.rint(fits.xy_px).astype(int)
    height, width = frame.dead.shape
    near = frame.dead[np.clip(xy[:, 1], 0, height - 1), np.clip(xy[:, 0], 0, width - 1)]
    keep = np.flatnonzero(good)
    keep = _one_per_place(fits.xy_px, fits.flux, keep, 1.2 * sigma)
    keep = keep[np.argsort(-fits.flux[keep], kind="stable")]
    return Detections(
        xy_px=fits.xy_px[keep],
        covariance_px2=fits.covariance[keep][:, :2, :2],
        flux_e=fits.flux[keep],
        flux_sigma_e=flux_sigma[keep],
        snr=fits.snr[keep],
        saturated=near[keep],
        psf_sigma_px=sigma,
        background_e=background,
        noise_e=noise,
    )


def _one_per_place(xy_px: NDArray[np.float64], flux: NDArray[np.float64], keep: Ints, closer_px: float) -> Ints:
    """Of sources that converged onto one place, the brightest."""
    from scipy.spatial import cKDTree

    order = keep[np.argsort(-flux[keep], kind="stable")]
    pairs = cKDTree(xy_px[order]).query_pairs(closer_px, output_type="ndarray")
    fainter = np.zeros(len(order), dtype=bool)
    fainter[pairs.max(axis=1)] = True
    return order[~fainter]
