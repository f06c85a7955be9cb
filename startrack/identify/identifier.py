"""Lost in space: which detection is which star, with no prior on the attitude."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from startrack.camera import Camera
from startrack.identify.chance import ChanceModel
from startrack.identify.index import PatternIndex, build_bright_index, build_index
from startrack.identify.kept import KeptPerObject
from startrack.identify.lean import Found, LeanSearch, scale_of
from startrack.identify.match import SIGNIFICANT_SNR, Matches, alike, brightest, match, taken, unexplained_by
from startrack.identify.near import NearStars
from startrack.identify.pairs import PairIndex, build_pairs
from startrack.identify.search import Search
from startrack.orient import AttitudeFit, solve_attitude
from startrack.types import Array, Detections, Identification, Ints, NotIdentified, Stars

FEWEST_MATCHES = 6
GATES_PX = (6.0, 3.0, 1.5)
SMALLEST_RADIUS_PX = 0.5
KEPT_PATTERNS = 4
REFINING_STARS = 300
ON_PLACE = 0.7  # of the stars within the widest gate are within the narrowest one, if the camera file is right
MOST_REFINED = 40
SHORT_LIST = 600  # detections up to which all may be held against all


@dataclass(frozen=True)
class Identifier:
    """Identifies by triangles and accepts by statistics: (Detections, Camera, Stars) -> Identification.

    An answer is accepted only where chance would produce as many coincidences with probability below
    `max_false_alarm`, all hypotheses tried included; otherwise NotIdentified is raised.
    """

    max_false_alarm: float = 1e-9
    tolerances_px: tuple[float, ...] = (0.7, 3.0)  # error of a ray: centroids first, then a rough calibration too
    depths: tuple[int, ...] = (30, 60, 120, 240)  # brightest detections that form triangles, round by round
    whole_field: bool = True  # refuse a camera that fits only a part of its field; a calibration may begin with one
    few: int = 16  # brightest detections whose pairs are tried where triangles of neighbours fail

    def __call__(self, detections: Detections, camera: Camera, stars: Stars) -> Identification:
        """Matches in the frame. `stars` are sorted, brightest first. Raises NotIdentified (or reason mirrored)."""
        patterns = _patterns(stars, _field_of(camera))
        try:
            return self._identify(detections, camera, patterns)
        except _RoughCamera:
            raise
        except NotIdentified:
            if self._solves(detections, replace(camera, mirrored=not camera.mirrored), patterns):
                raise NotIdentified(
                    "the image is a mirror image of what the camera file says: flip the image, or set mirrored = "
                    f"{str(not camera.mirrored).lower()} in the camera file",
                    reason="mirrored",
                ) from None
            raise

    def _solves(self, detections: Detections, camera: Camera, patterns: _Patterns) -> bool:
        try:
            self._identify(detections, camera, patterns)
        except NotIdentified:
            return False
        return True

    def _identify(self, detections: Detections, camera: Camera, patterns: _Patterns) -> Identification:
        rays_cam = camera.unproject(detections.xy_px)
        off_axis = np.arctan2(np.hypot(rays_cam[:, 0], rays_cam[:, 1]), rays_cam[:, 2])
        order = np.flatnonzero(off_axis <= camera.max_angle_rad)
        if len(order) < FEWEST_MATCHES:
            few = f"{len(order)} point sources are too few to identify: expose longer"
            raise NotIdentified(few, detected=len(order))
        tried = 0
        if len(order) <= SHORT_LIST:
            found, tried = self._short(detections, order, rays_cam[order], camera, patterns)
            if found is not None:
                return found
        search = Search(camera, rays_cam[order], patterns.stars, tried)
        refusal = "no triangle of stars is the catalogue's"
        for refined, R in enumerate(self._plausible(search, patterns)):
            if refined == MOST_REFINED:
                break
            try:
                return self._confirmed(detections, camera, patterns.stars, R, search)
            except _RoughCamera:
                raise
            except NotIdentified as cause:
                refusal = str(cause)
        raise NotIdentified(
            f"no attitude explains the {len(order)} point sources better than chance ({search.tried} tried; "
            f"{refusal}): is the camera file right, and is this the night sky?",
            detected=len(order),
            tried=search.tried,
        )

    def _short(
        self, detections: Detections, order: Ints, rays_cam: Array, camera: Camera, patterns: _Patterns
    ) -> tuple[Identification | None, int]:
        """What long triangles of the brightest few say, if anything, and the number of hypotheses tried."""
        inside = detections if len(order) == len(detections) else taken(detections, order)
        chance = ChanceModel(rays_cam)
        search = LeanSearch(camera, inside, rays_cam, patterns.stars, patterns.bright, patterns.near, chance)
        for refined, (R, detection, star) in enumerate(search.attitudes(self.tolerances_px[0])):
            if refined == MOST_REFINED:
                break
            found = search.refined(R, detection, star)
            if found is None:
                continue
            try:
                return self._named(search, found, detections, order), search.tried
            except _RoughCamera:
                raise
            except NotIdentified:
                continue
        return None, search.tried

    def _named(self, search: LeanSearch, found: Found, detections: Detections, order: Ints) -> Identification:
        """The matches of a short list, the detections `order`, judged as those of a long one are."""
        pairs = found.pairs
        distance = pairs.distance_px[found.matched]
        near = found.matched[distance < GATES_PX[-1]]
        named = near[pairs.alone(near, 3.0 * search.detections.psf_sigma_px)]
        if len(named) >= FEWEST_MATCHES:
            named = named[search.agree(pairs, named)[0]]
        if len(named) < FEWEST_MATCHES:
            raise NotIdentified(f"only {len(named)} stars match", matched=len(named))
        rms_px = float(np.sqrt(0.5 * np.mean(np.square(pairs.distance_px[named]))))
        radius_px = min(GATES_PX[-1], max(3.0 * rms_px, SMALLEST_RADIUS_PX))
        log_chance = self._log_chance(
            search.chance,
            int(np.count_nonzero(distance < radius_px)),
            len(found.predicted_v_mag),
            radius_px * scale_of(search.camera).on_axis,
            alike(found.predicted_v_mag, pairs.light.measured_mag),
            search.tried,
        )
        if self.whole_field:
            bright = distance[pairs.detection[found.matched] < REFINING_STARS]
            _refuse_rough_camera(bright[bright < GATES_PX[0]])
        unexplained = pairs.unexplained(search.detections.snr, GATES_PX[-1])
        if len(order) < len(detections):
            unexplained += int(np.count_nonzero(np.delete(detections.snr, order) > SIGNIFICANT_SNR))
        return Identification(
            detection=order[pairs.detection[named]],
            star=pairs.star[named],
            R_cam_icrs=found.R_cam_icrs,
            false_alarm_probability=float(np.exp(max(log_chance, -690.0))),
            unexplained=unexplained,
        )

    def _log_chance(
        self, chance: ChanceModel, hits: int, predicted: int, radius_rad: float, alike: float, tried: int
    ) -> float:
        """Log of the probability that chance gives as many hits; NotIdentified where that is not small enough."""
        odds = chance.log_odds(np.array(hits), np.array(max(predicted, hits)), radius_rad, alike=alike)
        log_chance = float(odds + np.log(tried))
        if log_chance > np.log(self.max_false_alarm):
            raise NotIdentified(f"the {hits} stars that match might do so by chance", matched=hits)
        return log_chance

    def _plausible(self, search: Search, patterns: _Patterns) -> Iterator[Array]:
        """Attitudes worth refining: triangles of ever more of the detections, then pairs of the brightest few."""
        for tolerance_px in self.tolerances_px:
            for done, depth in zip((0, *self.depths), self.depths, strict=False):
                if done < len(search.rays_cam):
                    yield from search.by_triangles(patterns.triangles, tolerance_px, (done, depth))
            yield from search.by_pairs(patterns.pairs, tolerance_px, self.few)

    def _confirmed(
        self, detections: Detections, camera: Camera, stars: Stars, R: Array, search: Search
    ) -> Identification:
        """The matches after refinement, judged at their own, much smaller radius; NotIdentified if chance might do."""
        fit, matches = _refined(detections, camera, stars, R)
        detection, star = matches.detection[fit.used], matches.star[fit.used]
        if len(star) < FEWEST_MATCHES:
            raise NotIdentified(f"only {len(star)} stars match after refinement", matched=len(star))
        radius_px = min(GATES_PX[-1], max(3.0 * fit.rms_px, SMALLEST_RADIUS_PX))
        log_chance = self._log_chance(
            ChanceModel(search.rays_cam),
            int(np.count_nonzero(matches.coincident_px < radius_px)),
            matches.predicted,
            radius_px * search.scale_rad_per_px,
            matches.alike,
            search.tried,
        )
        if self.whole_field:
            leaders = brightest(detections, REFINING_STARS)
            R_cam_icrs = fit.attitude.R_cam_icrs
            _refuse_rough_camera(match(leaders, camera, stars, R_cam_icrs, GATES_PX[0], 0.0).coincident_px)
        return Identification(
            detection=detection,
            star=star,
            R_cam_icrs=fit.attitude.R_cam_icrs,
            false_alarm_probability=float(np.exp(max(log_chance, -690.0))),
            unexplained=unexplained_by(
                detections, camera, stars, fit.attitude.R_cam_icrs, matches.zero_mag, GATES_PX[-1]
            ),
        )


class _RoughCamera(NotIdentified):
    """The sky is found, but the camera file's lens is not this one."""


def _refuse_rough_camera(distance_px: Array) -> None:
    """Raise where many of the bright stars lie near (n,), but not on, their places.

    Such a camera file fits a patch of the sky, and turns the attitude to suit it: 1 % of focal length is 0.8 degrees.
    """
    on_place, near = np.count_nonzero(distance_px < GATES_PX[-1]), len(distance_px)
    if on_place < ON_PLACE * near - 3.0 * np.sqrt(ON_PLACE * (1 - ON_PLACE) * near):
        raise _RoughCamera(
            f"only {on_place} of {near} bright stars lie within {GATES_PX[-1]:g} px of where the camera file puts "
            f"them, the others up to {GATES_PX[0]:g} px off: it is not the calibration of this lens",
            matched=on_place,
        )


def _patterns(stars: Stars, field_sr: float) -> _Patterns:
    """The patterns of these very stars; the last few are kept."""
    key = (_fingerprint_of(stars), field_sr)
    if key not in _KEPT:
        _KEPT[key] = _Patterns(stars, field_sr)
        while len(_KEPT) > KEPT_PATTERNS:
            _KEPT.popitem(last=False)
    _KEPT.move_to_end(key)
    return _KEPT[key]


class _Patterns:
    """The catalogue's patterns for a camera that sees `field_sr`, worked out when first asked for."""

    def __init__(self, stars: Stars, field_sr: float) -> None:
        self.stars, self.field_sr = stars, field_sr

    @cached_property
    def triangles(self) -> PatternIndex:
        return build_index(self.stars, self.field_sr)

    @cached_property
    def bright(self) -> PatternIndex:
        return build_bright_index(self.stars, self.field_sr)

    @cached_property
    def near(self) -> NearStars:
        return NearStars(self.stars)

    @cached_property
    def pairs(self) -> PairIndex:
        return build_pairs(self.stars, self.field_sr)


_KEPT: OrderedDict[tuple[object, float], _Patterns] = OrderedDict()


def _field_sr(camera: Camera) -> float:
    """Solid angle [sr] that the camera sees: of the image circle, or of the frame where that is smaller."""
    width, height = camera.size_px
    x, y = np.meshgrid(np.linspace(0, width - 1, 33), np.linspace(0, height - 1, 33))
    angle = camera.angle_rad(np.stack([x, y], axis=-1))
    cell = width * height / angle.size
    lit = angle < camera.max_angle_rad
    return float(np.sum(camera.pixel_solid_angle_sr(angle[lit]) * cell))


_field_of = KeptPerObject(_field_sr)
_fingerprint_of = KeptPerObject(lambda stars: (stars.rays_icrs.shape, stars.rays_icrs[:2000].tobytes()))


def _refined(detections: Detections, camera: Camera, stars: Stars, R: Array) -> tuple[AttitudeFit, Matches]:
    """Attitude and matches, gate by gate; the bright ones lead the way."""
    blend_px = 3.0 * detections.psf_sigma_px
    leaders = brightest(detections, REFINING_STARS)
    for some, gate_px in (*((leaders, gate) for gate in GATES_PX), (detections, GATES_PX[-1])):
        matches = match(some, camera, stars, R, gate_px, blend_px)
        if len(matches.star) < FEWEST_MATCHES:
            raise NotIdentified(f"only {len(matches.star)} stars match", matched=len(matches.star))
        d = matches.detection
        fit = solve_attitude(camera, some.xy_px[d], some.covariance_px2[d], stars.rays_icrs[matches.star], R)
        R = fit.attitude.R_cam_icrs
    return fit, matches
