"""Evidence from damaged frames: what a star's light becomes and how it scatters, measured on the frame itself.

Clipping and filters make the noise of an aperture another than its pixels state, and take light from faint stars. Stars
among visible bright ones give the response and the scatter of the light of visible stars, stars among missing
bright ones those of hidden stars. Neither needs a position.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.core.types import Array, Bools, Detections, NoSolution
from startrack.evidence.star_evidence import NOISE_BLOCK_PX, StarPhotometry, visibility_llr

LEFT_OUT_PART = 0.05  # of the brightest pixels in a block of the noise map, of the stars at both ends of a scatter
SMALLEST_NOISE = 0.2  # of the frame's median: of blocks of nearly one value
MARKER_SNR, MARKERS = 8.0, 4  # stars that mark the sky and the ground; how many of the nearest must agree
SEEN_PART = 0.5  # of the expected light; below half of it, the light of faint stars is lost rather than weakened
SNR_EDGES = np.array([0.0, 1.0, 1.5, 2.5, 4.0, 7.0, 15.0, 40.0, np.inf])  # groups of stars by expected snr
MIN_GROUP = 25  # stars in a group of visible ones, and half of the hidden ones
LEAST_SCATTER = 0.5  # of the hidden stars', in any group: a group of nearly one value is no Gaussian


@dataclass(frozen=True, eq=False)
class DamagedResponse:
    """Of groups (k,) of stars by their expected snr. Fluxes are in units of the stated noise of the aperture."""

    snr: Array  # (k,) typical
    gain: Array  # (k,) measured light per expected light; 0: lost
    scatter: Array  # (k,) standard deviation of visible stars
    hidden: float  # mean of hidden stars
    hidden_scatter: float

    def correct(self, light: StarPhotometry) -> StarPhotometry:
        """The photometry with the response in its expected fluxes, noise and evidence; none where light is lost."""
        noise = np.where(light.sigma_e > 0, light.sigma_e, 1.0)  # 0: not measured
        at = np.log(np.maximum(light.expected_e / noise, self.snr[0]))
        gain, scatter = (np.interp(at, np.log(self.snr), values) for values in (self.gain, self.scatter))
        flux, expected = light.flux_e - self.hidden * light.sigma_e, gain * light.expected_e
        llr = visibility_llr(flux, expected, self.hidden_scatter * noise, scatter * noise)
        sound = light.usable & (gain > SEEN_PART / 2)
        return replace(
            light, expected_e=expected, flux_e=flux, sigma_e=self.hidden_scatter * light.sigma_e,
            llr=np.where(sound, llr, 0.0),
        )  # fmt: skip


def measure_noise(detections: Detections) -> Detections:
    """The `detections` with a noise of the pixels that holds for clipped values too: their spread in blocks."""
    image, side = detections.image_e - detections.background_e, NOISE_BLOCK_PX
    height, width = image.shape
    rows, columns = -(-height // side), -(-width // side)
    padded = np.pad(image, ((0, rows * side - height), (0, columns * side - width)), mode="reflect")
    blocks = padded.reshape(rows, side, columns, side).transpose(0, 2, 1, 3).reshape(-1, side**2)
    kept = np.sort(blocks, axis=1)[:, : int((1.0 - LEFT_OUT_PART) * side**2)]
    spread = cv2.medianBlur(kept.std(axis=1).astype(np.float32).reshape(rows, columns), 5)
    usual = float(np.median(spread[spread > 0])) if spread.any() else 1.0
    noise: NDArray[np.float32] = cv2.resize(np.maximum(spread, SMALLEST_NOISE * usual), padded.shape[::-1])  # type: ignore[assignment]
    return replace(detections, noise_e=np.ascontiguousarray(noise[:height, :width]))


def measure_response(light: StarPhotometry) -> DamagedResponse:
    """The response of a frame to the stars of `light`. Raises NoSolution (damaged_image) where none is."""
    usable = np.flatnonzero(light.usable)
    noise = light.sigma_e[usable]
    snr, measured = light.expected_e[usable] / noise, light.flux_e[usable] / noise
    visible, hidden = _surely_visible_and_hidden(light.xy_px[usable], snr, measured)
    if np.count_nonzero(visible) < MIN_GROUP * (len(SNR_EDGES) - 1):
        raise NoSolution("too few stars show what is left of the light", reason="damaged_image")
    offset, scatter = 0.0, 0.0
    if np.count_nonzero(hidden) >= 2 * MIN_GROUP:
        offset, scatter = float(np.median(measured[hidden])), _scatter(measured[hidden])
    groups = []
    for low, high in pairwise(SNR_EDGES):
        one = visible & (snr > low) & (snr <= high)
        if np.count_nonzero(one) >= MIN_GROUP:
            typical = float(np.median(snr[one]))
            gain = float(np.median(measured[one] - offset)) / typical
            groups.append((typical, gain, _scatter(measured[one] - offset - gain * snr[one])))
    if not groups or max(gain for _, gain, _ in groups) < SEEN_PART:
        raise NoSolution("the light of the stars is lost", reason="damaged_image")
    typical, gains, scatters = np.array(groups).T
    scatter = scatter or float(scatters[0])
    return DamagedResponse(typical, gains, np.maximum(scatters, LEAST_SCATTER * scatter), offset, scatter)


def _surely_visible_and_hidden(xy_px: Array, snr: Array, measured: Array) -> tuple[Bools, Bools]:
    """Masks (n,) of the stars whose nearest bright stars are all seen, or all missing."""
    from scipy.spatial import cKDTree

    bright = np.flatnonzero(snr > MARKER_SNR)
    if len(bright) <= MARKERS:
        return np.zeros(len(snr), dtype=bool), np.zeros(len(snr), dtype=bool)
    seen = measured[bright] > SEEN_PART * snr[bright]
    _, nearest = cKDTree(xy_px[bright]).query(xy_px, MARKERS + 1)
    others = bright[nearest] != np.arange(len(snr))[:, None]  # a star is not its own witness
    count = np.count_nonzero(others & seen[nearest], axis=1)
    return count == np.count_nonzero(others, axis=1), count == 0


def _scatter(values: Array) -> float:
    """Standard deviation of values (n,), those at both ends clipped."""
    return float(np.std(np.clip(values, *np.percentile(values, [50 * LEFT_OUT_PART, 100 - 50 * LEFT_OUT_PART]))))
