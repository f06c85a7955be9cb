"""Identification without a camera file: the lens is found together with the stars."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from startrack.camera import Camera
from startrack.core import FIELD_TOLERANCE_1, NARROWEST_DEG, WIDEST_DEG
from startrack.core.limits import check_time, stating_work
from startrack.core.types import Array, Centroids, Identification, ImageCircle, NotIdentified, Stars
from startrack.estimation.adjust import observations_of_image
from startrack.estimation.false_alarm import probability
from startrack.estimation.radial_fit import radius_of
from startrack.identification.attitude_search import MIN_MATCHES
from startrack.identification.hypotheses import (
    MOST_DETECTIONS,
    HypothesisSearch,
    Window,
    remove_clumps,
)
from startrack.identification.lens_guesses import Field, guess_fields
from startrack.identification.lens_view import grow
from startrack.identification.lost_in_space import MAX_FALSE_ALARM
from startrack.identification.near_sky import NearSky
from startrack.identification.similar_triangles import BENT, LONG, STRAIGHT, PatternKind, patterns_for
from startrack.identification.verify_unknown_lens import VerifiedLens, Verifier, fit_found_lens

MIN_WIDE, MIN_NARROW = 2 * MIN_MATCHES, MIN_MATCHES + 1  # of a lens with many unknowns, and with its focal length alone
# The brightest; those after them, as hot pixels may be brighter than stars; and more of all.
FIRST_WINDOWS = (Window(0, 10), Window(0, 16), Window(0, 26))
LAST_WINDOWS = (Window(8, 24), Window(20, 42), Window(0, 40), Window(36, 60))
# Ratios fx / fy that are tried where square pixels explain nothing, and the windows. A narrow field's triangles allow
# for 2 % to either side, a wide one's for 4 %; 0.703 is that of anamorphic video.
WIDE_ASPECTS = (0.923, 1.083, 0.852, 1.174, 0.787, 1.271)
NARROW_ASPECTS = (0.961, 1.041, 0.923, 1.083, 0.887, 1.127, 0.852, 1.174, 0.819, 1.221, 0.787, 1.271, 0.703)
LONG_WINDOWS = (Window(0, 16, 30), Window(0, 26, 30), Window(0, 40, 30))  # where few of the detections are stars
ASPECT_WINDOWS = (Window(0, 16), Window(0, 26), Window(20, 42))
FEWEST_OF_WINDOW = 5  # detections that there are
LOG_FALSE_ALARM = float(np.log(MAX_FALSE_ALARM))
CLUMP_FRACTION = 0.01  # of the frame: detections used for patterns are no closer
CIRCLE_EDGE = 1.01  # of the disc's radius: detections beyond it are no stars
LAST_FITS = 4  # of matching and fitting a lens that is found


@dataclass(frozen=True)
class UnknownLensSolution:
    """The lens and the identification that it was found with."""

    camera: Camera  # name "unknown"; calibrated up to its outermost stars; with the covariance of its fit
    identification: Identification


def identify_unknown_lens(
    centroids: Centroids, size_px: tuple[int, int], fov_rad: float | tuple[float, float], stars: Stars, *,
    tolerance: float = FIELD_TOLERANCE_1, circle: ImageCircle | None = None, near_sky: NearSky | None = None,
) -> UnknownLensSolution:  # fmt: skip
    """Lens, attitude and matches of `centroids` in a frame of `size_px` (W, H), its field of view roughly known.

    `fov_rad`: a field of view, known to `tolerance`, or the smallest and the largest that it may have. Below 100
    degrees it is the angle across the frame's width, from there up that of the whole image circle, whether the frame
    clips it or not. `stars` are sorted, brightest first. `circle`: the image circle of a fisheye lens as it shows in
    the frame; it narrows the search. `near_sky`: part of the sky into which the optical axis points; others
    are not tried. An answer is accepted where chance would give as many coincidences with a probability below 1e-9, all
    trials included. Raises NotIdentified, and ValueError for an impossible field of view.
    """
    search = _Search(centroids, size_px, _range_of(fov_rad, tolerance), stars, circle, near_sky)
    for lens, field in search.lenses():
        if lens.log_p < LOG_FALSE_ALARM and len(lens.star) >= _least_matches(field):
            lens, camera, R = search.settle(lens, field)
            if near_sky is not None and not near_sky.contains(R):
                continue
            identification = Identification(
                detection=lens.detection, star=lens.star, R_cam_icrs=R, unexplained=lens.unexplained,
                false_alarm_probability=probability(lens.log_p),
            )  # fmt: skip
            return UnknownLensSolution(camera, identification)
    where = "" if near_sky is None else f" within {near_sky}"
    raise NotIdentified(
        f"no lens of {_field_text(fov_rad, tolerance)}{where} explains the {len(centroids)} point sources better than "
        f"chance ({search.tried_text})",
        advice=advise_on_fields(*search.range_rad, near_sky),
        detected=len(centroids),
        tried=search.hypotheses.tried,
    )


def _range_of(fov_rad: float | tuple[float, float], tolerance: float) -> tuple[float, float]:
    """The smallest and the largest field of view. Raises ValueError."""
    low, high = fov_rad if isinstance(fov_rad, tuple) else (fov_rad, fov_rad)
    if not 0 < low <= high <= 2 * np.pi:
        raise ValueError(f"fov_rad= is {fov_rad}: give radians, more than 0, at most 2 pi")
    return (low, high) if isinstance(fov_rad, tuple) else ((1 - tolerance) * low, (1 + tolerance) * high)


def _field_text(fov_rad: float | tuple[float, float], tolerance: float) -> str:
    if isinstance(fov_rad, tuple):
        return f"{np.degrees(fov_rad[0]):.3g} to {np.degrees(fov_rad[1]):.3g} degrees"
    return f"{np.degrees(fov_rad):.3g} degrees ({100 * tolerance:.0f} % more or less)"


def _least_matches(field: Field) -> int:
    return MIN_WIDE if field.is_wide else MIN_NARROW


def advise_on_fields(low_rad: float, high_rad: float, near_sky: NearSky | None) -> str:
    """Advice where no lens from `low_rad` to `high_rad` fits with the axis in `near_sky`, if it is given."""
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
        self, centroids: Centroids, size_px: tuple[int, int], range_rad: tuple[float, float], stars: Stars,
        circle: ImageCircle | None, near_sky: NearSky | None,
    ) -> None:  # fmt: skip
        self.centroids, self.size_px, self.range_rad, self.stars = centroids, size_px, range_rad, stars
        self.circle = circle
        circles = (None,) if circle is None else (circle, None)
        self.fields = guess_fields(size_px, *range_rad, circles)
        self.inside = np.arange(len(centroids))  # detections that may be stars
        if self.circle is not None and all(field.is_wide for field in self.fields):
            off = np.linalg.norm(centroids.xy_px - self.circle.centre_px, axis=1)
            self.inside = np.flatnonzero(off < CIRCLE_EDGE * self.circle.radius_px)
        self.xy_px = centroids.xy_px[self.inside]
        chosen = remove_clumps(self.xy_px, CLUMP_FRACTION * min(size_px), MOST_DETECTIONS)
        fewest = min(_least_matches(field) for field in self.fields)
        if len(chosen) < fewest:
            apart = "" if len(chosen) == len(centroids) else f" of {len(centroids)} that stand apart"
            raise NotIdentified(
                f"{len(chosen)} point source{'s' * (len(chosen) != 1)}{apart}: too few to identify without a camera "
                f"file, which takes {fewest}",
                advice="try a longer exposure, or a camera file, with which fewer suffice",
                detected=len(centroids),
            )
        self.aspects: tuple[float, ...] = ()  # tried beside square pixels
        margin_rad = 0.25 * (range_rad[1] - range_rad[0])
        self.hypotheses = HypothesisSearch(self.xy_px[chosen], size_px, near_sky, margin_rad)
        self.verifier = Verifier(centroids, stars)

    @property
    def tried_text(self) -> str:
        """Text about the number of patterns tried."""
        points = f"the {len(self.hypotheses.xy_px)} brightest that stand apart"
        ratios = (
            f" with square pixels and with fx / fy from {min(self.aspects):.2g} to {max(self.aspects):.3g}"
            if self.aspects
            else ""
        )
        return f"{self.hypotheses.tried} patterns of {points}{ratios} tried"

    def lenses(self) -> Iterator[tuple[VerifiedLens, Field]]:
        """Verified lenses with their fields, whatever their p-value."""
        low, high = np.degrees(self.range_rad)
        field = f"{low:.3g} to {high:.3g} degrees, {len(self.centroids)} point sources"
        with stating_work(lambda: f"{field}: {self.tried_text}"):
            for one in self.fields:
                yield from self._lenses_of(one, STRAIGHT if one.is_narrow else BENT, (1.0,), FIRST_WINDOWS)
            for one in reversed(self.fields):  # the patterns of the last fields are at hand
                kind, aspects = (STRAIGHT, NARROW_ASPECTS) if one.is_narrow else (BENT, WIDE_ASPECTS)
                yield from self._lenses_of(one, kind, (1.0,), LAST_WINDOWS)
                if one.is_narrow:
                    yield from self._lenses_of(one, LONG, (1.0,), LONG_WINDOWS)
                self.aspects += aspects
                yield from self._lenses_of(one, kind, aspects, ASPECT_WINDOWS)

    def _lenses_of(
        self, field: Field, kind: PatternKind, aspects: tuple[float, ...], windows: tuple[Window, ...]
    ) -> Iterator[tuple[VerifiedLens, Field]]:
        """The lenses of a field that the hypotheses of its guesses grow to, those with the most votes first."""
        search = self.hypotheses
        patterns = patterns_for(self.stars, kind.sizes(field.solid_angle_sr))
        for window, aspect in product(windows, aspects):
            if window.first and len(search.xy_px) <= window.first + FEWEST_OF_WINDOW:
                continue
            guesses = [guess.with_aspect(aspect, keeps_width=not field.is_wide) for guess in field.guesses]
            found = [(one, guess) for guess in guesses for one in search.voted_hypotheses(patterns, guess, window)]
            for hypothesis, guess in sorted(found, key=lambda one: -one[0].agreeing):
                check_time()
                field_px = 2 * guess.focal_px * float(radius_of(np.array(field.fov_rad / 2), guess.bend))
                grown = grow(hypothesis, self.xy_px, self.stars.rays_icrs, field, field_px)
                if grown is None:
                    continue
                view, detection, star = grown
                lens = self.verifier(view, self.inside[detection], star, search.log_trials, field)
                if lens is not None:
                    yield lens, field

    def settle(self, lens: VerifiedLens, field: Field) -> tuple[VerifiedLens, Camera, Array]:
        """The `lens` with the stars of its last fit, the camera and attitude of that fit.

        A fit with more unknowns than those of the search places more stars: it is repeated with these.
        """
        middle = (self.size_px[0] - 1) / 2, (self.size_px[1] - 1) / 2
        centre_px = self.circle.centre_px if self.circle is not None and field.is_wide else middle
        for _ in range(LAST_FITS):
            seen, rays_icrs = lens.detection, self.stars.rays_icrs[lens.star]
            xy_px, covariance_px2 = self.centroids.xy_px[seen], self.centroids.covariance_px2[seen]
            points = observations_of_image(xy_px, covariance_px2, rays_icrs)
            camera, R = fit_found_lens(lens.camera, lens.R_cam_icrs, points, centre_px)
            more = self.verifier.match_lens(camera, R, lens.scale, self.hypotheses.log_trials, field)
            if more is None or len(more.star) <= len(lens.star):
                break
            lens = replace(more, log_p=min(lens.log_p, more.log_p))
        return lens, camera, R
