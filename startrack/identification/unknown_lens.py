"""Which star is which without a camera file: the lens is found with the attitude."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from startrack.camera import Camera
from startrack.identification.hypotheses import (
    Guess,
    Hypotheses,
    PatternSizes,
    Window,
    apart,
    narrow_sizes,
    patterns_for,
    wide_sizes,
)
from startrack.identification.image_circle import Circle, image_circle
from startrack.identification.joint_adjust import fitted_jointly
from startrack.identification.radial_lens_family import PINHOLE, radius
from startrack.identification.refine_unknown_lens import Polished, polished
from startrack.identification.region_growing import WIDE, Grown, Stage, grow
from startrack.identification.unknown_lens_narrow import NarrowSearch
from startrack.identification.unknown_lens_verify import Judged
from startrack.types import Array, Detections, Identification, Ints, NotIdentified, Stars

WIDE_FIELD_RAD = np.radians(100.0)  # from here up, `fov` is the angle of the image circle
NARROW_FIELD_RAD = np.radians(40.0)  # up to here all lenses are nearly pinholes
FEWEST_WIDE = 12
FEWEST_NARROW = 7
WINDOWS = (  # the brightest; those after them, as hot pixels may be brighter than stars; and more of all
    Window(0, 0, 16), Window(0, 16, 26), Window(26, 26, 46), Window(0, 26, 40), Window(46, 46, 70), Window(0, 40, 60),
)  # fmt: skip
LOG_PLAUSIBLE = -11.0  # of a start's chance hits: random skies reach -15 in a whole search
LOG_FALSE_ALARM = float(np.log(1e-9))
MOST_TRIED = 600_000  # patterns; a search without an answer ends here, after some seconds
MOST_TRIED_IN_CIRCLE = 250_000  # where the image circle is seen: real photographs take 1000 to 110,000
MOST_TRIED_BEYOND = 100_000  # more, as if it were not, in case that it is something else
ROOM = 1.3  # around a narrow field, for its focal length and centre are not known
APART = 0.01  # of the frame: pattern stars are no closer
CIRCLES = (0.5, 0.62, 0.42, 0.78, 1.0)  # radius of the image circle over the frame's shorter side
SEEN_CIRCLES = (1.0, 1.25)  # radius at half the field over that of the disc that is seen: a dome may hide the horizon
EDGE = 1.01  # of the disc's radius: point sources beyond it are no stars
NARROW_WINDOWS = (
    Window(0, 0, 8), Window(0, 8, 14), Window(14, 14, 26), Window(0, 14, 22), Window(26, 26, 40), Window(0, 22, 32),
)  # fmt: skip
NARROW_PATTERNS = (
    (10, 0.8, 2),
    (18, 0.5, 6),
    (48, 0.28, 6),
)  # stars in the field, longest side over its diameter, windows
FIELD_STEPS = 4.0  # indexes are made for fields a fourth part of a factor e apart
WIDE_SHAPES = (-0.35, 0.25, -0.8, 0.7)
MIDDLE_SHAPES = (PINHOLE, 0.4, -0.4)
TRY = "is the field of view right, is this the night sky, and in focus? With a camera file fewer stars suffice"


@dataclass(frozen=True)
class BlindSolution:
    """The lens and the stars that it was found with."""

    camera: Camera  # name "unknown"; calibrated as far out as its stars reach; with the covariance of its fit
    identification: Identification


def identify_blind(
    detections: Detections, size_px: tuple[int, int], fov_rad: float, stars: Stars, *, tolerance: float = 0.1
) -> BlindSolution:
    """Lens, attitude and matches of a frame (W, H) whose field of view is known to about the relative tolerance.

    `fov_rad`: below 100 degrees the angle across the frame's width, from there up that of the whole image circle,
    whether the frame clips it or not. `stars` are sorted, brightest first. An answer is accepted where chance would
    give as many coincidences with probability below 1e-9, all trials included. Raises NotIdentified.
    """
    search = _Search(detections, size_px, fov_rad, stars, tolerance)
    if search.narrow and (quick := _quickly(search, detections)) is not None:
        return quick
    for grown, around in search.grown():
        answer = polished(grown, detections, stars.take(around), search.tried, search.widest_rad)
        if answer is not None and answer.log_chance < LOG_FALSE_ALARM and answer.matched >= search.fewest:
            return _solution(answer, around, search, detections)
    raise NotIdentified(
        f"no lens of {np.degrees(fov_rad):.3g} degrees ({100 * tolerance:.0f} % more or less) explains the "
        f"{len(detections)} point sources better than chance ({search.tried} patterns tried): {TRY}",
        detected=len(detections),
        tried=search.tried,
    )


def _quickly(search: _Search, detections: Detections) -> BlindSolution | None:
    """A narrow field by the votes of its brightest stars' triangles; None where that does not suffice."""
    narrow = NarrowSearch(
        detections, search.chosen, search.size_px, search.fov_rad, search.rounded_field_sr(), search.stars
    )
    for found in narrow.found():
        said = found.judged
        if said.log_chance < LOG_FALSE_ALARM and len(said.star) >= search.fewest:
            return _solution(said, found.around, search, detections)
    search.hypotheses.tried += narrow.tried
    return None


def _solution(answer: Polished | Judged, around: Ints, search: _Search, detections: Detections) -> BlindSolution:
    """The answer with lens and attitude fitted to all its stars together, so that the lens's errors are known."""
    star, seen = around[answer.star], answer.detection
    joint = fitted_jointly(
        answer.camera, answer.R_cam_icrs, detections.xy_px[seen], detections.covariance_px2[seen],
        search.stars.rays_icrs[star], centre=not search.narrow,
    )  # fmt: skip
    return BlindSolution(
        camera=joint.camera,
        identification=Identification(
            detection=seen,
            star=star,
            R_cam_icrs=joint.R_cam_icrs,
            false_alarm_probability=float(np.exp(max(answer.log_chance, -690.0))),
            unexplained=answer.unexplained,
        ),
    )


class _Search:
    """What is tried, in order of likelihood."""

    def __init__(
        self, detections: Detections, size_px: tuple[int, int], fov_rad: float, stars: Stars, tolerance: float
    ) -> None:
        self.size_px, self.fov_rad, self.stars, self.tolerance = size_px, fov_rad, stars, tolerance
        self.wide = fov_rad >= WIDE_FIELD_RAD
        self.fewest = FEWEST_WIDE if self.wide else FEWEST_NARROW
        self.circle = image_circle(detections.background_e) if self.wide else None
        self.xy_px = detections.xy_px
        if self.circle is not None:
            off = np.linalg.norm(self.xy_px - self.circle.centre_px, axis=1)
            self.xy_px = self.xy_px[off < EDGE * self.circle.radius_px]
        self.narrow = fov_rad <= NARROW_FIELD_RAD
        self.chosen = chosen = apart(self.xy_px, APART * min(size_px), 100)
        if len(chosen) < self.fewest:
            raise NotIdentified(
                f"{len(chosen)} point sources are too few to identify without a camera file, which takes "
                f"{self.fewest}: expose longer, or {TRY}",
                detected=len(detections),
            )
        self.hypotheses = Hypotheses(self.xy_px[chosen], size_px)

    @property
    def tried(self) -> int:
        """Patterns tried so far."""
        return self.hypotheses.tried

    @property
    def widest_rad(self) -> float:
        """Half the field, generously."""
        return 0.5 * self.fov_rad * (1 + self.tolerance)

    def grown(self) -> Iterator[tuple[Grown, Ints]]:
        """Hypotheses that survive growing, and the stars (indices) that they speak of."""
        if self.circle is None:
            yield from self._searched(self._guesses(), MOST_TRIED)
            return
        yield from self._searched(self._guesses_in(self.circle), MOST_TRIED_IN_CIRCLE)
        yield from self._searched(self._guesses(), self.tried + MOST_TRIED_BEYOND)

    def _searched(self, guesses: list[Guess], most_tried: int) -> Iterator[tuple[Grown, Ints]]:
        """`grown` of some lenses, until so many patterns have been tried."""
        stages = self._stages()
        for sizes, window in self._rounds():
            patterns = patterns_for(self.stars, sizes)
            if window.done >= len(self.hypotheses.xy_px):
                continue
            for guess in guesses:
                taken: list[Array] = []
                for start in self.hypotheses.starts(patterns, guess, window, LOG_PLAUSIBLE):
                    if any(np.trace(R.T @ start.R_cam_icrs) > 1 + 2 * np.cos(0.05) for R in taken):
                        continue
                    taken.append(start.R_cam_icrs)
                    around = self._around(start.R_cam_icrs[2])
                    rays = self.stars.rays_icrs if self.wide else self.stars.rays_icrs[around]
                    found = grow(start, self.xy_px, rays, stages)
                    if found is not None and (not self.wide or len(found.star) >= self.fewest):
                        yield found, around
                if self.tried > most_tried:
                    return

    def _rounds(self) -> Iterator[tuple[PatternSizes, Window]]:
        """Which patterns of the catalogue and which of the detections, in turn."""
        field_sr = self.rounded_field_sr()
        if not self.narrow:
            yield from ((wide_sizes(field_sr), window) for window in WINDOWS)
            return
        for in_field, reach, windows in NARROW_PATTERNS:
            yield from ((narrow_sizes(field_sr, in_field, reach), window) for window in NARROW_WINDOWS[:windows])

    def _around(self, axis_icrs: Array) -> Ints:
        """Indices of the stars that a narrow camera may see; for wide ones all of them."""
        if self.wide:
            return np.arange(len(self.stars))
        reach = np.arctan(np.tan(self.fov_rad / 2) * np.hypot(*self.size_px) / self.size_px[0])
        return np.flatnonzero(self.stars.rays_icrs @ axis_icrs > np.cos(reach * ROOM))

    def _guesses(self) -> list[Guess]:
        """Lenses to begin with: shapes by focal lengths, the likelier first."""
        width, height = self.size_px
        centre = ((width - 1) / 2, (height - 1) / 2)
        if not self.wide:
            shapes = (PINHOLE,) if self.narrow else MIDDLE_SHAPES
            return [Guess(width / 2 / float(radius(np.array(self.fov_rad / 2), s)), s, centre) for s in shapes]
        shorter, diagonal = min(self.size_px), float(np.hypot(*self.size_px))
        circles = [c * shorter for c in CIRCLES if c * shorter < 0.56 * diagonal]
        return self._fisheyes(circles, centre)

    def _guesses_in(self, circle: Circle) -> list[Guess]:
        """Lenses whose image circle is the one seen, or somewhat larger."""
        return self._fisheyes([c * circle.radius_px for c in SEEN_CIRCLES], circle.centre_px)

    def _fisheyes(self, circles_px: list[float], centre_px: tuple[float, float]) -> list[Guess]:
        return [
            Guess(circle / float(radius(np.array(self.fov_rad / 2), shape)), shape, centre_px)
            for circle in circles_px
            for shape in WIDE_SHAPES
            if abs(shape) * self.fov_rad / 2 < np.radians(80.0)
        ]

    def rounded_field_sr(self) -> float:
        """The solid angle, so rounded that one index serves many fields."""
        return float(np.exp(np.round(FIELD_STEPS * np.log(self._field_sr())) / FIELD_STEPS))

    def _field_sr(self) -> float:
        """Solid angle of the frame, or of the image circle."""
        if self.wide:
            return float(2 * np.pi * (1 - np.cos(min(self.fov_rad / 2, np.pi / 2))))
        half = np.tan(self.fov_rad / 2)
        other = half * self.size_px[1] / self.size_px[0]
        return float(4 * np.arcsin(half * other / np.sqrt((1 + half**2) * (1 + other**2))))

    def _stages(self) -> tuple[Stage, ...]:
        """The stages of growing, smaller for smaller fields."""
        if self.wide:
            return WIDE
        part = float(np.sqrt(self._field_sr() / (2 * np.pi)))
        if self.narrow:
            return tuple(replace(s, gate_rad=s.gate_rad * part, free=("scale",)) for s in WIDE if s.reach_rad == np.pi)
        return tuple(
            replace(s, reach_rad=s.reach_rad * (part if s.reach_rad < np.pi else 1.0), gate_rad=s.gate_rad * part)
            for s in WIDE
        )
