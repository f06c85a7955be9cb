"""Evidence of the stars: for every catalogue star in view, is it visible or hidden?

Clipping and filters make the noise of an aperture another than its pixels state, and take light from faint stars. In
such a damaged frame stars among visible bright ones give the response and the scatter of the light of visible stars,
stars among missing bright ones those of hidden stars. Neither needs a position.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.camera import Camera
from startrack.core.types import (
    Array,
    Body,
    Bools,
    Detections,
    Evidence,
    Ints,
    NoSolution,
    SmoothImage,
    Stars,
    sector_of,
)
from startrack.evidence.expected_stars import BAD_PIXELS, USABLE, ExpectedStars, expect_stars
from startrack.evidence.flux_scale import FluxScale
from startrack.evidence.photometry import Photometry, Sources, measure
from startrack.frames import Air, turn_sky
from startrack.psf import noise_area_px

DECIDABLE_SNR = 2.0  # of stars whose own flux shows whether they are visible
NOISE_BLOCK_PX = 16  # both ways: the noise is interpolated between blocks of 16 px
SEEN_LLR = 3.0  # from here on a star counts as seen, from minus this as hidden
MISSING_PROBABILITY = 2e-3  # a visible star is not measured: variable, wrong entry, small obstacle
ANOMALY_PROBABILITY = 1e-3  # light where the ground is: track, reflection, defect
CAP = 9.0  # natural logarithm; largest evidence of one star
LEFT_OUT_PART = 0.05  # of the brightest pixels in a block of the noise map, of the stars at both ends of a scatter
SMALLEST_NOISE = 0.2  # of the frame's median: of blocks of nearly one value
MARKER_SNR, MARKERS = 8.0, 4  # stars that mark the sky and the ground; how many of the nearest must agree
SEEN_PART = 0.5  # of the expected light; below half of it, the light of faint stars is lost rather than weakened
SNR_EDGES = np.array([0.0, 1.0, 1.5, 2.5, 4.0, 7.0, 15.0, 40.0, np.inf])  # groups of stars by expected snr
MIN_GROUP = 25  # stars in a group of visible ones, and half of the hidden ones
LEAST_SCATTER = 0.5  # of the hidden stars', in any group: a group of nearly one value is no Gaussian


@dataclass(frozen=True, kw_only=True)
class StarPhotometry(ExpectedStars):
    """Expected and measured light of each catalogue star in the frame (n); the star table's rows."""

    flux_e: Array  # measured
    sigma_e: Array  # of the measured flux without a star
    llr: Array  # 0 where unusable
    edge_sigma_rad: Array | float = 0.0  # (n,) of the height above the skyline, while the shutter is open

    @property
    def cause(self) -> NDArray[np.str_]:
        """Cause (n,) why each star is unusable; "" where it is usable."""
        return np.array(self.causes)[self.cause_code]

    @property
    def usable(self) -> Bools:
        """Whether each star (n,) is evidence."""
        return np.asarray(self.cause_code == USABLE)

    def mask_stars(self, reason: NDArray[np.str_]) -> StarPhotometry:
        """Copy without evidence where there is a `reason` (n,) against it; an earlier cause stays."""
        texts = tuple(np.unique(reason[self.usable & (reason != "")]).tolist())
        code = self.cause_code.copy()
        for number, text in enumerate(texts, start=len(self.causes)):
            code[self.usable & (reason == text)] = number
        return replace(self, cause_code=code, causes=self.causes + texts, llr=np.where(code == USABLE, self.llr, 0.0))

    def turn_frame(self, R: Array, air: Air | None) -> StarPhotometry:
        """Copy under a sky that a rotation `R` (3, 3) in enu has turned beyond the `air`."""
        azimuth, elevation = turn_sky(self.azimuth_rad, self.elevation_rad, R, air)
        return replace(self, azimuth_rad=azimuth, elevation_rad=elevation)

    def replace_stars(self, newer: StarPhotometry, which: Ints) -> StarPhotometry:
        """Copy with the rows of the stars `which` by the `newer` measurement, where both contain the star."""
        there = np.flatnonzero(np.isin(newer.star, which))
        here = np.searchsorted(self.star, newer.star[there])
        causes = self.causes + tuple(text for text in newer.causes if text not in self.causes)
        fresh = replace(newer, cause_code=np.array([causes.index(text) for text in newer.causes])[newer.cause_code])
        changed = {}
        for name in ("flux_e", "sigma_e", "llr", "cause_code"):
            values = getattr(self, name).copy()
            values[here] = getattr(fresh, name)[there]
            changed[name] = values
        return replace(self, **changed, causes=causes)

    def moving(self, motion_rad: Array) -> StarPhotometry:
        """Copy whose stars move by `motion_rad` (SECTORS,) [rad] across the skyline while the shutter is open.

        All parts of the way are equally likely: a star is visible for the part above the skyline.
        """
        return replace(self, edge_sigma_rad=motion_rad[sector_of(self.azimuth_rad)] / np.sqrt(12.0))

    def evidence(self) -> Evidence:
        """Evidence of the usable stars, for the localizer."""
        use = self.usable
        return Evidence(
            azimuth_rad=self.azimuth_rad[use],
            elevation_rad=self.elevation_rad[use],
            llr=self.llr[use],
            edge_sigma_rad=np.broadcast_to(self.edge_sigma_rad, len(use))[use],
        )


@dataclass(frozen=True)
class StarPhotometer:
    """Forced photometry at the catalogue's stars, turned into log-likelihood ratios."""

    def __call__(
        self,
        detections: Detections,
        camera: Camera,
        stars: Stars,
        bodies: list[Body],
        R_cam_icrs: Array,
        R_enu_icrs: Array,
        scale: FluxScale,
        position_sigma_px: float,
        visible: Array | None = None,
        air: Array | None = None,
    ) -> StarPhotometry:
        """Photometry of every star in view.

        The image of the `detections` is measured, with its background, noise and PSF. `visible` (len(stars),) is the
        probability that each star is visible where that is known already; it is used for the star's light in its
        neighbours' measurements only. `camera`, `stars`, `bodies`, `R_cam_icrs`, `R_enu_icrs`, `scale`,
        `position_sigma_px` and `air` are those of `expect_stars`.
        """
        found = expect_stars(
            camera, stars, bodies, R_cam_icrs, R_enu_icrs, scale, psf_sigma_px=detections.psf_sigma_px,
            noise_e=filtered_noise_e(detections), position_sigma_px=position_sigma_px, mask=detections.mask, air=air,
        )  # fmt: skip
        sources = found.sources(0.5)
        shining = _guess_visibility(detections, sources) if visible is None else visible[found.star[found.measurable]]
        return self.judge(found, measure(detections, replace(sources, visible=shining)))

    def judge(self, found: ExpectedStars, light: Photometry) -> StarPhotometry:
        """The stars expected (`found`) with the `light` at the measurable ones, and its log-likelihood ratios."""
        which, cause = found.measurable, found.cause_code.copy()
        llr, sigma = _ratios(light, found.expected_e[which], found.fraction_sigma[which])
        cause[which[~light.usable & (cause[which] == USABLE)]] = BAD_PIXELS
        columns = np.zeros((3, len(found.star)))
        columns[:, which] = light.flux_e, sigma, np.where(cause[which] == USABLE, llr, 0.0)
        measured = dict(zip(("flux_e", "sigma_e", "llr"), columns, strict=True))
        return StarPhotometry(**vars(found) | measured | {"cause_code": cause})


def filtered_noise_e(detections: Detections) -> float:
    """Typical noise [e] of a star's flux: that of a pixel of the `detections`, through the matched filter."""
    some = np.ix_(*(np.arange(0, length, NOISE_BLOCK_PX) for length in detections.image_e.shape))
    pixel_e = float(np.median(detections.noise.at(*some)))
    return pixel_e * float(np.sqrt(noise_area_px(detections.psf_sigma_px)))


def _guess_visibility(detections: Detections, sources: Sources) -> Array:
    """Probability (n,) that each star is visible, before a position is known: by their own flux for the brighter ones.

    It weights their light in their neighbours' measurements; one half for the faint ones.
    """
    shining = np.full(len(sources.flux_e), 0.5)
    noise_e = detections.noise.at(*np.rint(sources.xy_px).astype(int).T[::-1])
    area_px = noise_area_px(detections.psf_sigma_px)
    bright = np.flatnonzero(sources.flux_e > DECIDABLE_SNR * noise_e * np.sqrt(area_px))
    if len(bright):
        expected, fraction = sources.flux_e[bright], sources.fraction_sigma[bright]
        hidden = np.zeros(len(bright))
        alone = Sources(xy_px=sources.xy_px[bright], flux_e=expected, fraction_sigma=fraction, visible=hidden)
        llr, _ = _ratios(measure(detections, alone), expected, fraction)
        shining[bright] = 1.0 / (1.0 + np.exp(-llr))
    return shining


def _ratios(light: Photometry, expected_e: Array, fraction: Array) -> tuple[Array, Array]:
    """Log-likelihood ratios (n,) and the standard deviations (n,) [e] of the fluxes without a star."""
    hidden = light.variance_e2 + light.neighbour_variance_e2
    shining = hidden + light.own_shot * expected_e + np.square(fraction * expected_e)
    sigma = np.sqrt(hidden)
    return visibility_llr(light.flux_e, expected_e, sigma, np.sqrt(shining)), sigma


def visibility_llr(flux_e: Array, expected_e: Array, sigma_hidden_e: Array, sigma_shining_e: Array) -> Array:
    """Log-likelihood ratios (n,), ln p(flux | visible) - ln p(flux | hidden), capped.

    Visible: Gaussian about the expected flux, or with a small probability about nothing. Hidden: Gaussian about
    nothing, or with a small probability any flux up to twice the expected one.
    """
    at_star = _log_normal(flux_e - expected_e, sigma_shining_e)
    at_zero = _log_normal(flux_e, sigma_hidden_e)
    anything = -np.log(2.0 * expected_e + 10.0 * sigma_hidden_e)
    # Under either hypothesis the measurement may be an outlier; this floor limits the weight of one outlier.
    shines = np.logaddexp(np.log1p(-MISSING_PROBABILITY) + at_star, np.log(MISSING_PROBABILITY) + at_zero)
    shines = np.logaddexp(shines, np.log(ANOMALY_PROBABILITY) + anything)
    hidden = np.logaddexp(np.log1p(-ANOMALY_PROBABILITY) + at_zero, np.log(ANOMALY_PROBABILITY) + anything)
    return np.clip(shines - hidden, -CAP, CAP)


def _log_normal(x: Array, sigma: Array) -> Array:
    return -0.5 * np.square(x / sigma) - np.log(sigma) - 0.5 * np.log(2 * np.pi)


@dataclass(frozen=True, eq=False)
class DamagedResponse:
    """The response of a damaged frame to groups (k,) of stars by expected snr; fluxes in units of the stated noise."""

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


def with_noise_of_blocks(detections: Detections) -> Detections:
    """The `detections` with noise (H, W) [e] that holds for clipped values too: the spread in blocks.

    The largest values of each block are left out.
    """
    image, side = detections.image_e - detections.background_e, NOISE_BLOCK_PX
    height, width = image.shape
    padded = np.pad(image, ((0, -height % side), (0, -width % side)), mode="reflect")
    rows, columns = padded.shape[0] // side, padded.shape[1] // side
    blocks = padded.reshape(rows, side, columns, side).transpose(0, 2, 1, 3).reshape(-1, side**2)
    kept = np.sort(blocks, axis=1)[:, : int((1.0 - LEFT_OUT_PART) * side**2)]
    spread = cv2.medianBlur(kept.std(axis=1).astype(np.float32).reshape(rows, columns), 5)
    usual = float(np.median(spread[spread > 0])) if spread.any() else 1.0
    noise: NDArray[np.float32] = cv2.resize(np.maximum(spread, SMALLEST_NOISE * usual), padded.shape[::-1])  # type: ignore[assignment]
    return replace(detections, noise=SmoothImage.of(np.ascontiguousarray(noise[:height, :width])))


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
