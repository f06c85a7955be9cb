"""Evidence of the stars: for every catalogue star in view, is it visible or hidden?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from startrack.camera import Camera
from startrack.core.types import Array, Body, Bools, Detections, Evidence, Ints, Stars
from startrack.evidence.expected_stars import BAD_PIXELS, USABLE, ExpectedStars, expect_stars
from startrack.evidence.flux_scale import FluxScale
from startrack.evidence.likelihood_ratio import gaussian_llr, visibility_llr
from startrack.evidence.photometry import Photometry, Sources, measure
from startrack.frames import turn_azel
from startrack.psf import noise_area_px

MIN_SNR = 0.6  # a sixth of the time less than with 0.5; mean errors grow by 2 % (60 frames, with the sky's light)
MIN_PSF_AREAS_PER_STAR = 2.0  # with more stars in the pixels the same light would be counted twice
DECIDABLE_SNR = 2.0  # of stars whose own flux shows whether they are visible
NOISE_STEP_PX = 16  # both ways: the noise is interpolated between blocks of 16 px
SEEN_LLR = 3.0  # from here on a star counts as seen, from minus this as hidden


@dataclass(frozen=True, kw_only=True)
class StarPhotometry:
    """Expected and measured light of each catalogue star in the frame (n); the star table's rows."""

    star: Ints  # index into Stars
    xy_px: Array  # (n, 2) predicted
    azimuth_rad: Array
    elevation_rad: Array
    expected_e: Array
    flux_e: Array  # measured
    sigma_e: Array  # of the measured flux without a star
    llr: Array  # 0 where unusable
    cause_code: NDArray[np.int8]  # index into `causes`; 0 where usable
    causes: tuple[str, ...]  # why stars are unusable; the first is ""

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
        return Evidence(
            azimuth_rad=self.azimuth_rad[use],
            elevation_rad=self.elevation_rad[use],
            llr=self.llr[use],
        )


@dataclass(frozen=True)
class StarEvidence:
    """Forced photometry at the catalogue's stars, turned into log-likelihood ratios."""

    faintest_snr: float = MIN_SNR
    crowded: float = MIN_PSF_AREAS_PER_STAR
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

        Args:
            detections: their image, its background and noise, and the PSF are used.
            camera: projects the stars.
            stars: of the catalogue, brightest first.
            bodies: whose glare spoils the stars beside them.
            R_cam_icrs: (3, 3).
            R_enu_icrs: (3, 3).
            scale: of the fluxes.
            position_sigma_px: error of the predicted pixels per axis.
            visible: (len(stars),) probability that each star is visible where that is known already; it is used for
                the star's light in its neighbours' measurements only.
        """
        sigma_px = detections.psf_sigma_px
        found = expect_stars(
            camera, stars, bodies, R_cam_icrs, R_enu_icrs, scale, psf_sigma_px=sigma_px,
            least_e=self.least_e(filtered_noise_e(detections)), area_px=self.area_px(sigma_px),
            position_sigma_px=position_sigma_px, mask=detections.mask,
        )  # fmt: skip
        sources = found.sources(0.5)
        shining = _guess_visibility(detections, sources) if visible is None else visible[found.star[found.measurable]]
        return self.judge(found, measure(detections, replace(sources, visible=shining)))

    def least_e(self, noise_e: float) -> float:
        """Expected flux [e] below which stars are left out, with noise of `noise_e` through the matched filter."""
        return self.faintest_snr * max(noise_e, 1e-9)

    def area_px(self, psf_sigma_px: float) -> float:
        """Area of the image [px^2] that each star needs, for a PSF of `psf_sigma_px`."""
        return self.crowded * noise_area_px(psf_sigma_px)

    def judge(self, found: ExpectedStars, light: Photometry) -> StarPhotometry:
        """The stars expected (`found`) with the `light` at the measurable ones, and its log-likelihood ratios."""
        which, cause = found.measurable, found.cause_code.copy()
        llr, sigma = _ratios(light, found.flux_e[which], found.fraction_sigma[which], self.capped)
        cause[which[~light.usable & (cause[which] == USABLE)]] = BAD_PIXELS
        n = len(found.star)
        return StarPhotometry(
            star=found.star,
            xy_px=found.xy_px,
            azimuth_rad=found.azimuth_rad,
            elevation_rad=found.elevation_rad,
            expected_e=found.flux_e,
            flux_e=_scatter_rows(light.flux_e, which, n),
            sigma_e=_scatter_rows(sigma, which, n),
            llr=np.where(cause == USABLE, _scatter_rows(llr, which, n), 0.0),
            cause_code=cause,
            causes=found.causes,
        )


def filtered_noise_e(detections: Detections) -> float:
    """Typical noise [e] of a star's flux: that of a pixel, through the matched filter."""
    pixel_e = float(np.median(detections.noise_e[::NOISE_STEP_PX, ::NOISE_STEP_PX]))
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
        alone = Sources(
            xy_px=sources.xy_px[bright], flux_e=expected, fraction_sigma=fraction, visible=np.zeros(len(bright))
        )
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


def _scatter_rows(values: Array, index: Ints, n: int) -> Array:
    full = np.zeros(n)
    full[index] = values
    return full
