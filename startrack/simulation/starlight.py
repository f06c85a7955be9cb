"""Forced photometry of a frame that is never rendered: means and variances of its fluxes, and normal draws of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.evidence.photometry import Photometry, Sources, half_width
from startrack.psf import pixel_profile, pixel_profile_single
from startrack.types import Array, Ints

NEIGHBOUR_SIGMAS = 3.0  # of the PSF beyond half a stamp, to the last star whose light is subtracted, as in `measure`
CORNER = float(np.sqrt(2.0))  # half diagonal of a stamp in its half widths: light reaches its corners, too


@dataclass(frozen=True, eq=False)
class Starlight:
    """The stars that shine on a frame (m), and its PSF."""

    xy_px: Array  # (m, 2)
    flux_e: Array  # (m,) whole PSF
    psf_sigma_px: float

    def measure(
        self, sources: Sources, pixel_variance_e2: Array, saturation_e: float, *, rng: np.random.Generator
    ) -> Photometry:
        """A draw of what `startrack.evidence.photometry.measure` finds at the sources (n).

        The background is known, and the noise of a pixel without stars is the same over the stamp of a star,
        `pixel_variance_e2` (n,). The weights are those of linear least squares for flux and local level; the light of
        `sources` is subtracted as expected, all light of the stars here adds to the flux and to its noise. The errors
        of overlapping stamps are drawn independently. A star with a pixel above `saturation_e` is not usable.
        """
        sigma, radius = self.psf_sigma_px, half_width(self.psf_sigma_px)
        stamps = _Stamps.about(sources.xy_px, sigma, radius)
        mean, shot = np.zeros((2, len(sources.flux_e)))
        subtracted, subtracted_shot, unsure = np.zeros((3, len(sources.flux_e)))
        reach_px = radius + NEIGHBOUR_SIGMAS * sigma
        _, own_shot = stamps.part_of(np.arange(len(stamps.pixel)), sources.xy_px)
        star, other = _pairs(sources.xy_px, self.xy_px, CORNER * radius + NEIGHBOUR_SIGMAS * sigma)
        part, noise = stamps.part_of(star, self.xy_px[other])
        np.add.at(mean, star, part * self.flux_e[other])
        np.add.at(shot, star, noise * self.flux_e[other])
        star, other = _pairs(sources.xy_px, sources.xy_px, reach_px)
        star, other = star[star != other], other[star != other]
        part, noise = stamps.part_of(star, sources.xy_px[other])
        light, visible = sources.flux_e[other], sources.visible[other]
        spread = visible * (1.0 - visible) + visible * np.square(sources.fraction_sigma[other])
        np.add.at(subtracted, star, part * light * visible)
        np.add.at(subtracted_shot, star, noise * light * visible)
        np.add.at(unsure, star, np.square(part * light) * spread)
        without_stars = pixel_variance_e2 / stamps.strength
        noise_e = np.sqrt(np.maximum(without_stars + shot, 0.0))
        flux = mean - subtracted + noise_e * rng.standard_normal(len(mean))
        peak = self.flux_e * np.square(pixel_profile(np.zeros(1), sigma, 0)[0][0, 0])
        bright = self.xy_px[peak > saturation_e]
        saturated = np.zeros(len(mean), dtype=bool)
        saturated[_pairs(sources.xy_px, bright, radius)[0]] = True
        return Photometry(
            flux_e=flux, variance_e2=without_stars + subtracted_shot, own_shot=own_shot,
            neighbour_variance_e2=unsure, usable=~saturated,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Stamps:
    """The pixels about stars (n) and the weights of their profiles, P - mean(P) over `strength`."""

    pixel: Ints  # (n, 2) in the middle
    across: Array  # (n, side) profile in x
    down: Array  # (n, side) profile in y
    middle: Array  # (n,) mean of the profile
    strength: Array  # (n,) sum of P (P - mean)
    sigma_px: float
    radius: int

    @classmethod
    def about(cls, xy_px: Array, sigma_px: float, radius: int) -> _Stamps:
        """Those about positions (n, 2)."""
        pixel = np.rint(xy_px)
        offset = xy_px - pixel
        across, down = (pixel_profile(offset[:, axis], sigma_px, radius)[0] for axis in (0, 1))
        total = across.sum(axis=1) * down.sum(axis=1)
        middle = total / across.shape[1] ** 2
        strength = np.square(across).sum(axis=1) * np.square(down).sum(axis=1) - middle * total
        return cls(pixel.astype(np.int64), across, down, middle, strength, sigma_px, radius)

    def part_of(self, star: Ints, xy_px: Array) -> tuple[Array, Array]:
        """Of the light at `xy_px` (k, 2): the part (k,) that stamp `star` (k,) takes for its star's, and the variance
        that each of its electrons adds.
        """
        offset = xy_px - self.pixel[star]
        sums = [self._sums(profile[star], offset[:, axis]) for axis, profile in enumerate((self.across, self.down))]
        light, with_profile, with_square = (x * y for x, y in zip(*sums, strict=True))
        middle, strength = self.middle[star], self.strength[star]
        part = (with_profile - middle * light) / strength
        variance = (with_square - 2.0 * middle * with_profile + np.square(middle) * light) / np.square(strength)
        return part, variance

    def _sums(self, own: Array, offset_px: Array) -> tuple[Array, Array, Array]:
        """Along one axis, sums (k,) of a neighbour's profile alone, times the star's `own` (k, side), and times its
        square.
        """
        other = pixel_profile_single(offset_px, self.sigma_px, self.radius)[0].astype(np.float64)
        return other.sum(axis=1), np.einsum("kp,kp->k", other, own), np.einsum("kp,kp,kp->k", other, own, own)


def _pairs(xy_px: Array, others_px: Array, reach_px: float) -> tuple[Ints, Ints]:
    """Indices (k,) of positions (n, 2) and of `others_px` (m, 2) that are within reach of each other."""
    from scipy.spatial import cKDTree

    if not len(xy_px) or not len(others_px):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    near = cKDTree(xy_px).sparse_distance_matrix(cKDTree(others_px), reach_px, output_type="ndarray")
    return near["i"].astype(np.int64), near["j"].astype(np.int64)
