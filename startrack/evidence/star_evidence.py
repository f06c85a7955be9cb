"""Evidence of the stars: for every catalogue star in view, is it visible or hidden?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from startrack.camera import Camera
from startrack.core.types import Array, Body, Bools, Detections, Evidence, Ints, Stars
from startrack.evidence.expected_stars import BAD_PIXELS, USABLE, ExpectedStars, FluxScale, expect_stars
from startrack.evidence.photometry import Photometry, Sources, measure
from startrack.frames import turn_azel
from startrack.psf import noise_area_px

DECIDABLE_SNR = 2.0  # of stars whose own flux shows whether they are visible
NOISE_BLOCK_PX = 16  # both ways: the noise is interpolated between blocks of 16 px
SEEN_LLR = 3.0  # from here on a star counts as seen, from minus this as hidden
MISSING_PROBABILITY = 2e-3  # a visible star is not measured: variable, wrong entry, small obstacle
ANOMALY_PROBABILITY = 1e-3  # light where the ground is: track, reflection, defect
CAP = 9.0  # natural logarithm; largest evidence of one star


@dataclass(frozen=True, kw_only=True)
class StarPhotometry(ExpectedStars):
    """Expected and measured light of each catalogue star in the frame (n); the star table's rows."""

    flux_e: Array  # measured
    sigma_e: Array  # of the measured flux without a star
    llr: Array  # 0 where unusable

    @property
    def cause(self) -> NDArray[np.str_]:
        """Why each star (n,) is unusable; "" where it is usable."""
        return np.array(self.causes)[self.cause_code]

    @property
    def usable(self) -> Bools:
        """Whether each star (n,) is evidence."""
        return np.asarray(self.cause_code == USABLE)

    def masked(self, reason: NDArray[np.str_]) -> StarPhotometry:
        """The same with no evidence where there is a reason (n,) against it; an earlier cause stays."""
        texts = tuple(np.unique(reason[self.usable & (reason != "")]).tolist())
        code = self.cause_code.copy()
        for number, text in enumerate(texts, start=len(self.causes)):
            code[self.usable & (reason == text)] = number
        return replace(self, cause_code=code, causes=self.causes + texts, llr=np.where(code == USABLE, self.llr, 0.0))

    def turned(self, R: Array) -> StarPhotometry:
        """The same under a sky turned by a rotation `R` (3, 3) in enu."""
        azimuth, elevation = turn_azel(self.azimuth_rad, self.elevation_rad, R)
        return replace(self, azimuth_rad=azimuth, elevation_rad=elevation)

    def replace_stars(self, newer: StarPhotometry, which: Ints) -> StarPhotometry:
        """Replace the rows of the stars `which` by the newer measurement, where both contain the star."""
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

    def evidence(self) -> Evidence:
        """The rays for the localizer."""
        use = self.usable
        return Evidence(azimuth_rad=self.azimuth_rad[use], elevation_rad=self.elevation_rad[use], llr=self.llr[use])


@dataclass(frozen=True)
class StarEvidence:
    """Forced photometry at the catalogue's stars, turned into log-likelihood ratios."""

    capped: bool = True  # False: plain Gaussian ratios, to measure the effect of the caps

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
    ) -> StarPhotometry:
        """Photometry of every star in view.

        The image of the `detections` is measured, with its background, noise and PSF. `visible` (len(stars),) is the
        probability that each star is visible where that is known already; it is used for the star's light in its
        neighbours' measurements only. `camera`, `stars`, `bodies`, `R_cam_icrs`, `R_enu_icrs`, `scale` and
        `position_sigma_px` are those of `expect_stars`.
        """
        found = expect_stars(
            camera, stars, bodies, R_cam_icrs, R_enu_icrs, scale, psf_sigma_px=detections.psf_sigma_px,
            noise_e=filtered_noise_e(detections), position_sigma_px=position_sigma_px, mask=detections.mask,
        )  # fmt: skip
        sources = found.sources(0.5)
        shining = _guess_visibility(detections, sources) if visible is None else visible[found.star[found.measurable]]
        return self.judge(found, measure(detections, replace(sources, visible=shining)))

    def judge(self, found: ExpectedStars, light: Photometry) -> StarPhotometry:
        """The stars expected (`found`) with the `light` at the measurable ones, and its log-likelihood ratios."""
        which, cause = found.measurable, found.cause_code.copy()
        llr, sigma = _ratios(light, found.expected_e[which], found.fraction_sigma[which], self.capped)
        cause[which[~light.usable & (cause[which] == USABLE)]] = BAD_PIXELS
        columns = np.zeros((3, len(found.star)))
        columns[:, which] = light.flux_e, sigma, np.where(cause[which] == USABLE, llr, 0.0)
        measured = dict(zip(("flux_e", "sigma_e", "llr"), columns, strict=True))
        return StarPhotometry(**vars(found) | measured | {"cause_code": cause})


def filtered_noise_e(detections: Detections) -> float:
    """Typical noise [e] of a star's flux: that of a pixel of the `detections`, through the matched filter."""
    pixel_e = float(np.median(detections.noise_e[::NOISE_BLOCK_PX, ::NOISE_BLOCK_PX]))
    return pixel_e * float(np.sqrt(noise_area_px(detections.psf_sigma_px)))


def _guess_visibility(detections: Detections, sources: Sources) -> Array:
    """Probability (n,) that each star is visible, before a position is known: by their own flux for the brighter ones.

    It weights their light in their neighbours' measurements; one half for the faint ones.
    """
    shining = np.full(len(sources.flux_e), 0.5)
    noise_e = detections.noise_e[tuple(np.rint(sources.xy_px).astype(int).T[::-1])]
    area_px = noise_area_px(detections.psf_sigma_px)
    bright = np.flatnonzero(sources.flux_e > DECIDABLE_SNR * noise_e * np.sqrt(area_px))
    if len(bright):
        expected, fraction = sources.flux_e[bright], sources.fraction_sigma[bright]
        hidden = np.zeros(len(bright))
        alone = Sources(xy_px=sources.xy_px[bright], flux_e=expected, fraction_sigma=fraction, visible=hidden)
        llr, _ = _ratios(measure(detections, alone), expected, fraction)
        shining[bright] = 1.0 / (1.0 + np.exp(-llr))
    return shining


def _ratios(light: Photometry, expected_e: Array, fraction: Array, capped: bool = True) -> tuple[Array, Array]:
    """Log-likelihood ratios and the standard deviations of the fluxes without a star."""
    hidden = light.variance_e2 + light.neighbour_variance_e2
    shining = hidden + light.own_shot * expected_e + np.square(fraction * expected_e)
    sigma = np.sqrt(hidden)
    ratio = visibility_llr if capped else gaussian_llr
    return ratio(light.flux_e, expected_e, sigma, np.sqrt(shining)), sigma


def visibility_llr(flux_e: Array, expected_e: Array, sigma_hidden_e: Array, sigma_shining_e: Array) -> Array:
    """ln p(flux | visible) - ln p(flux | hidden) (n,), capped.

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


def gaussian_llr(flux_e: Array, expected_e: Array, sigma_hidden_e: Array, sigma_shining_e: Array) -> Array:
    """The ratio without outliers and without a cap, for comparisons only."""
    return _log_normal(flux_e - expected_e, sigma_shining_e) - _log_normal(flux_e, sigma_hidden_e)


def _log_normal(x: Array, sigma: Array) -> Array:
    return -0.5 * np.square(x / sigma) - np.log(sigma) - 0.5 * np.log(2 * np.pi)
