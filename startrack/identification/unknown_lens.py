"""Identification without a camera file: the lens is found together with the stars."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.camera import Camera
from startrack.core import FIELD_TOLERANCE_1, NARROWEST_DEG, WIDEST_DEG
from startrack.core.time_limit import check_time, stating_work
from startrack.core.types import Array, Centroids, Identification, NotIdentified, Stars
from startrack.estimation.false_alarm import probability
from startrack.estimation.normal_equations import observations_of_image
from startrack.identification.attitude_search import MIN_MATCHES
from startrack.identification.found_lens import fit_found_lens
from startrack.identification.hypotheses import HypothesisSearch, Window, remove_clumps
from startrack.identification.lens_guesses import (
    MIDDLE_SHAPES,
    PINHOLE,
    LensGuess,
    guess_fisheyes,
    guess_lenses,
    image_circle,
)
from startrack.identification.lost_in_space import MAX_FALSE_ALARM
from startrack.identification.narrow_field import narrow_lenses
from startrack.identification.near_sky import NearSky
from startrack.identification.region_growing import WIDE_STAGES, GrowthStage, grow
from startrack.identification.similar_triangles import (
    MAX_DETECTIONS,
    PatternSizes,
    narrow_sizes,
    patterns_for,
    wide_sizes,
)
from startrack.identification.verify_unknown_lens import FITTED_BEYOND_1, VerifiedLens, match_lens, verify

WIDE_FIELD_RAD = np.radians(100.0)  # from here up, `fov_rad` is the angle of the image circle
NARROW_FIELD_RAD = np.radians(40.0)  # up to here all lenses are nearly pinholes
MIN_WIDE, MIN_NARROW = 2 * MIN_MATCHES, MIN_MATCHES + 1  # of a lens with many unknowns, and with its focal length alone
WINDOWS = (  # the brightest; those after them, as hot pixels may be brighter than stars; and more of all
    Window(0, 0, 16), Window(0, 16, 26), Window(26, 26, 46), Window(0, 26, 40), Window(46, 46, 70), Window(0, 40, 60),
)  # fmt: skip
NARROW_WINDOWS = (
    Window(0, 0, 8), Window(0, 8, 14), Window(14, 14, 26), Window(0, 14, 22), Window(26, 26, 40), Window(0, 22, 32),
)  # fmt: skip
NARROW_PATTERNS = ((10, 0.8, 2), (18, 0.5, 6), (48, 0.28, 6))  # stars in the field, longest side over it, windows
LOG_FALSE_ALARM = float(np.log(MAX_FALSE_ALARM))
MAX_TRIED = 600_000  # patterns; a search without an answer ends here, after some seconds
MAX_TRIED_IN_CIRCLE = 250_000  # where the image circle is seen: real photographs take 1000 to 110,000
MAX_TRIED_BEYOND = 100_000  # further patterns without the image circle, in case the disc found is not it
CLUMP_FRACTION = 0.01  # of the frame: detections used for patterns are no closer
CIRCLE_EDGE = 1.01  # of the disc's radius: detections beyond it are no stars
FIELD_STEPS_PER_E = 4.0  # indexes are made for fields a fourth part of a factor e apart
# Ratios fx / fy that are tried in a narrow field where square pixels explain nothing, each good for 2 % to either side:
# those of video of 720 x 576 (15/16, 45/64) and 720 x 480 (9/8, 27/32), and pictures stretched or squeezed by a tenth.
ASPECTS = (15 / 16, 16 / 15, 9 / 8, 8 / 9, 27 / 32, 45 / 64)
LAST_FITS = 4  # of matching and fitting a lens that is found
SAME_LENS_RAD = 0.05  # between attitudes


@dataclass(frozen=True)
class UnknownLensSolution:
    """The lens and the identification that it was found with."""

    camera: Camera  # name "unknown"; calibrated up to its outermost stars; with the covariance of its fit
    identification: Identification


def identify_unknown_lens(
    centroids: Centroids, size_px: tuple[int, int], fov_rad: float, stars: Stars, *,
    tolerance: float = FIELD_TOLERANCE_1, background: NDArray[Any] | None = None, near_sky: NearSky | None = None,
) -> UnknownLensSolution:  # fmt: skip
    """Lens, attitude and matches of `centroids` in a frame of `size_px` (W, H), its field of view known to `tolerance`.

    `fov_rad`: below 100 degrees the angle across the frame's width, from there up that of the whole image circle,
    whether the frame clips it or not. `stars` are sorted, brightest first. `background` (H, W): smooth background of
    the frame, in which the image circle of a fisheye lens is looked for; it narrows the search. `near_sky`: part of the
    sky into which the optical axis points; attitudes elsewhere are not tried. An answer is accepted where chance would
    give as many coincidences with a probability below 1e-9, all trials included. Raises NotIdentified, and ValueError
    for an impossible field of view.
    """
    if not 0 < fov_rad <= 2 * np.pi:
        raise ValueError(f"fov_rad= is {fov_rad:g}: give radians, more than 0, at most 2 pi")
    search = _Search(centroids, size_px, fov_rad, stars, tolerance, background, near_sky)
    for lens in search.lenses():
        if lens.log_p < LOG_FALSE_ALARM and len(lens.star) >= search.min_matches:
            lens, camera, R = search.settle(lens)
            if near_sky is not None and not near_sky.contains(R):
                continue
            identification = Identification(
                detection=lens.detection, star=lens.star, R_cam_icrs=R, unexplained=lens.unexplained,
                false_alarm_probability=probability(lens.log_p),
            )  # fmt: skip
            return UnknownLensSolution(camera, identification)
    where = "" if near_sky is None else f" within {near_sky}"
    raise NotIdentified(
        f"no lens of {np.degrees(fov_rad):.3g} degrees ({100 * tolerance:.0f} % more or less){where} explains the "
        f"{len(centroids)} point sources better than chance ({search.tried_text})",
        advice=advise_on_fields(fov_rad * (1 - tolerance), fov_rad * (1 + tolerance), near_sky),
        detected=len(centroids),
        tried=search.hypotheses.tried,
    )


def pixels_text(aspects: tuple[float, ...]) -> str:
    """The shapes of pixels tried, to be added to the patterns: square, and with the ratios `aspects`, if any."""
    ratios = ", ".join(f"{aspect:.3g}" for aspect in aspects)
    return f" with square pixels and with fx / fy = {ratios}" if aspects else ""


def advise_on_fields(low_rad: float, high_rad: float, near_sky: NearSky | None) -> str:
    """What may be tried where no lens from `low_rad` to `high_rad` fits with the axis in `near_sky`, if it is given."""
    low, high = np.degrees([low_rad, high_rad])
    wider = max(low / 2, NARROWEST_DEG), min(2 * high, WIDEST_DEG)
    words = ["if there is a camera file, give it: fewer stars suffice"]
    if wider[0] < 0.99 * low or wider[1] > 1.01 * high:
        range_text = f"{wider[0]:.3g}..{wider[1]:.3g}"
        words.insert(0, f"if the field of view may be another, try startrack identify --fov {range_text}")
    if near_sky is not None:
        words.append("if the axis may point elsewhere, leave out near_sky")
    return "; ".join(words)


class _Search:
    """Lenses that may explain a list of centroids, in order of likelihood."""

    def __init__(
        self, centroids: Centroids, size_px: tuple[int, int], fov_rad: float, stars: Stars, tolerance: float,
        background: NDArray[Any] | None, near_sky: NearSky | None,
    ) -> None:  # fmt: skip
        self.centroids, self.size_px, self.fov_rad, self.stars = centroids, size_px, fov_rad, stars
        self.widest_rad = 0.5 * fov_rad * (1 + tolerance)
        self.wide, self.narrow = fov_rad >= WIDE_FIELD_RAD, fov_rad <= NARROW_FIELD_RAD
        self.min_matches = MIN_WIDE if self.wide else MIN_NARROW
        self.circle = image_circle(background) if self.wide and background is not None else None
        self.xy_px = centroids.xy_px
        if self.circle is not None:
            off = np.linalg.norm(self.xy_px - self.circle.centre_px, axis=1)
            self.xy_px = self.xy_px[off < CIRCLE_EDGE * self.circle.radius_px]
        chosen = remove_clumps(self.xy_px, CLUMP_FRACTION * min(size_px), MAX_DETECTIONS)
        if len(chosen) < self.min_matches:
            apart = "" if len(chosen) == len(centroids) else f" of {len(centroids)} that stand apart"
            raise NotIdentified(
                f"{len(chosen)} point source{'s' * (len(chosen) != 1)}{apart}: too few to identify without a camera "
                f"file, which takes {self.min_matches}",
                advice="try a longer exposure, or a camera file, with which fewer suffice",
                detected=len(centroids),
            )
        self.aspects: tuple[float, ...] = ()  # tried beside square pixels
        self.hypotheses = HypothesisSearch(self.xy_px[chosen], size_px, near_sky, 0.5 * fov_rad * tolerance)
        middle = (size_px[0] - 1) / 2, (size_px[1] - 1) / 2
        self.centre_px = middle if self.circle is None else self.circle.centre_px  # expected one of the lens
        half = np.tan(fov_rad / 2)
        other = half * size_px[1] / size_px[0]
        # Solid angle of the image circle, or of the frame.
        self.field_sr = float(
            2 * np.pi * (1 - np.cos(min(fov_rad / 2, np.pi / 2)))
            if self.wide
            else 4 * np.arcsin(half * other / np.sqrt((1 + half**2) * (1 + other**2)))
        )
        # Rounded, one index serves many fields.
        self.rounded_sr = float(np.exp(np.round(FIELD_STEPS_PER_E * np.log(self.field_sr)) / FIELD_STEPS_PER_E))

    @property
    def tried_text(self) -> str:
        """The work done."""
        points = f"the {len(self.hypotheses.xy_px)} brightest that stand apart"
        return f"{self.hypotheses.tried} patterns of {points}{pixels_text(self.aspects)} tried"

    def lenses(self) -> Iterator[VerifiedLens]:
        """Verified lenses, whatever their p-value."""
        field = f"{np.degrees(self.fov_rad):.3g} degrees, {len(self.centroids)} point sources"
        with stating_work(lambda: f"{field}: {self.tried_text}"):
            yield from self._lenses()

    def _lenses(self) -> Iterator[VerifiedLens]:
        if self.narrow:
            yield from narrow_lenses(self.centroids, self.hypotheses, self.fov_rad, self.rounded_sr, self.stars)
        if not self.wide:
            shapes = (PINHOLE,) if self.narrow else MIDDLE_SHAPES
            yield from self._grow_all(guess_lenses(self.size_px, self.fov_rad, shapes), MAX_TRIED)
            if self.narrow:
                yield from self._stretched_lenses()
            return
        most = MAX_TRIED
        if self.circle is not None:
            yield from self._grow_all(guess_fisheyes(self.size_px, self.fov_rad, self.circle), MAX_TRIED_IN_CIRCLE)
            most = self.hypotheses.tried + MAX_TRIED_BEYOND
        yield from self._grow_all(guess_fisheyes(self.size_px, self.fov_rad, None), most)

    def _stretched_lenses(self) -> Iterator[VerifiedLens]:
        """Lenses of a narrow field whose pixels are not square, from detections stretched to square ones."""
        for number, aspect in enumerate(ASPECTS, 1):
            by_px = np.array([1.0 / aspect, 1.0])
            shift_px = 0.5 * (by_px - 1.0)  # pixel centres are at integers
            size_px = round(self.size_px[0] / aspect), self.size_px[1]
            xy_px = self.hypotheses.xy_px * by_px + shift_px
            search = HypothesisSearch(xy_px, size_px, self.hypotheses.near_sky, self.hypotheses.margin_rad)
            search.tried = self.hypotheses.tried
            seen = replace(
                self.centroids,
                xy_px=self.centroids.xy_px * by_px + shift_px,
                covariance_px2=self.centroids.covariance_px2 * np.outer(by_px, by_px),
            )
            for lens in narrow_lenses(seen, search, self.fov_rad, self.rounded_sr, self.stars):
                x, y = ((np.array(lens.camera.centre_px) - shift_px) / by_px).tolist()
                focal_px = lens.camera.focal_px[0] * aspect, lens.camera.focal_px[1]
                yield replace(
                    lens, camera=replace(lens.camera, size_px=self.size_px, focal_px=focal_px, centre_px=(x, y))
                )
            self.hypotheses.tried, self.aspects = search.tried, ASPECTS[:number]

    def settle(self, lens: VerifiedLens) -> tuple[VerifiedLens, Camera, Array]:
        """The `lens` with the stars of its last fit, the camera and attitude of that fit.

        A fit with more unknowns than those of the search places more stars: it is repeated with these.
        """
        for _ in range(LAST_FITS):
            seen, rays_icrs = lens.detection, self.stars.rays_icrs[lens.star]
            xy_px, covariance_px2 = self.centroids.xy_px[seen], self.centroids.covariance_px2[seen]
            points = observations_of_image(xy_px, covariance_px2, rays_icrs)
            camera, R = fit_found_lens(lens.camera, lens.R_cam_icrs, points, self.centre_px)
            more = match_lens(camera, R, self.centroids, self.stars, self.hypotheses.log_trials, self.widest_rad)
            if more is None or len(more.star) <= len(lens.star):
                break
            lens = replace(more, log_p=min(lens.log_p, more.log_p))
        return lens, camera, R

    def _grow_all(self, guesses: list[LensGuess], max_tried: int) -> Iterator[VerifiedLens]:
        """The lenses that the hypotheses of these guesses grow to, until so many patterns have been tried."""
        search, stages = self.hypotheses, self._stages()
        corner = np.arctan(np.tan(self.fov_rad / 2) * np.hypot(*self.size_px) / self.size_px[0])
        nearest_1 = np.cos(corner * FITTED_BEYOND_1)  # of the axis to stars that a camera that is not wide may see
        for sizes, window in self._rounds():
            patterns = patterns_for(self.stars, sizes)
            if window.done >= len(search.xy_px):
                continue
            for guess in guesses:
                seen: list[Array] = []
                for hypothesis in search.likely_hypotheses(patterns, guess, window):
                    R = hypothesis.R_cam_icrs
                    if any(np.trace(other.T @ R) > 1 + 2 * np.cos(SAME_LENS_RAD) for other in seen):
                        continue
                    seen.append(R)
                    check_time()
                    around = None if self.wide else np.flatnonzero(self.stars.rays_icrs @ R[2] > nearest_1)
                    stars = self.stars if around is None else self.stars.take(around)
                    grown = grow(hypothesis, self.xy_px, stars.rays_icrs, stages)
                    if grown is None or (self.wide and grown[2] < self.min_matches):
                        continue
                    lens = verify(*grown, self.centroids, stars, search.log_trials, self.widest_rad)
                    if lens is not None:
                        yield lens if around is None else replace(lens, star=around[lens.star])
                if search.tried > max_tried:
                    return

    def _rounds(self) -> Iterator[tuple[PatternSizes, Window]]:
        """Patterns of the catalogue and windows of detections, in turn."""
        if not self.narrow:
            yield from ((wide_sizes(self.rounded_sr), window) for window in WINDOWS)
            return
        for in_field, side, windows in NARROW_PATTERNS:
            yield from ((narrow_sizes(self.rounded_sr, in_field, side), w) for w in NARROW_WINDOWS[:windows])

    def _stages(self) -> tuple[GrowthStage, ...]:
        """The stages of growth, smaller for smaller fields."""
        if self.wide:
            return WIDE_STAGES
        part = float(np.sqrt(self.field_sr / (2 * np.pi)))
        if self.narrow:
            whole = (s for s in WIDE_STAGES if s.radius_rad == np.pi)
            return tuple(replace(s, gate_rad=s.gate_rad * part, free=("f", "fy")) for s in whole)
        return tuple(
            replace(s, radius_rad=s.radius_rad * (part if s.radius_rad < np.pi else 1.0), gate_rad=s.gate_rad * part)
            for s in WIDE_STAGES
        )
