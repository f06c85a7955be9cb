"""Lost in space: which detection is which star, with no prior on the attitude."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from startrack.camera import Camera
from startrack.identification.attitudes import AttitudeSearch, Turned
from startrack.identification.chance import WIDEST_NEIGHBOURHOOD_RAD, ChanceModel
from startrack.identification.index import Patterns, patterns_of
from startrack.identification.match import SIGNIFICANT_SNR, alike, taken
from startrack.identification.matching import DIMMED_MAG, middle
from startrack.identification.refine_attitude import (
    BLEND_SIGMAS,
    FIRST_GATE_PX,
    GATE_PX,
    ON_PLACE_PX,
    Found,
    Refiner,
    reach_px,
)
from startrack.identification.scale import Scale, scale_of
from startrack.types import Array, Bools, Detections, Identification, Ints, NotIdentified, Stars

FEWEST_MATCHES = 6
SMALLEST_RADIUS_PX = 0.5
BRIGHT_DETECTIONS = 300  # by which a camera is judged
ON_PLACE = 0.7  # of the stars within the widest gate are within the narrowest one, if the camera file is right
MOST_REFINED = 40
TOLERANCE_SIGMAS = 3.0
LOCAL_PART = 0.1  # of the field's diameter: within it the density of detections counts


@dataclass(frozen=True)
class Identifier:
    """Identifies by triangles and accepts by statistics: (Detections, Camera, Stars) -> Identification.

    An answer is accepted only where chance would produce as many coincidences with probability below
    `max_false_alarm`, all hypotheses tried included; otherwise NotIdentified is raised.
    """

    max_false_alarm: float = 1e-9
    tolerances_px: tuple[float, float] = (0.7, 3.0)  # error of a ray: centroids first, then a rough calibration too
    whole_field: bool = True  # refuse a camera that fits only a part of its field; a calibration may begin with one

    def __call__(self, detections: Detections, camera: Camera, stars: Stars) -> Identification:
        """Matches in the frame. `stars` are sorted, brightest first. Raises NotIdentified (or reason mirrored)."""
        scale = scale_of(camera)
        patterns = patterns_of(stars, scale.field_sr)
        rays_cam = camera.unproject(detections.xy_px)
        order = np.flatnonzero(rays_cam[:, 2] >= np.cos(camera.max_angle_rad))
        if len(order) < FEWEST_MATCHES:
            few = f"{len(order)} point sources are too few to identify: expose longer"
            raise NotIdentified(few, detected=len(order))
        seen = _Seen(detections, order, rays_cam[order], patterns, camera, scale)
        search = AttitudeSearch(seen.rays_cam, patterns, scale, reach_px(seen.detections) * scale.largest)
        tolerance_px, rough_px = self.tolerances_px
        tolerance_px = min(max(tolerance_px, TOLERANCE_SIGMAS * middle(seen.variance_px2) ** 0.5), rough_px)
        found, refusal = self._first(search.attitudes(tolerance_px, rough_px), seen, search)
        if found is not None:
            return found
        lenient = replace(self, whole_field=False)
        if lenient._first(search.mirror_images(), seen.mirrored(), search)[0] is not None:
            raise NotIdentified(
                "the image is a mirror image of what the camera file says: flip the image, or set mirrored = "
                f"{str(not camera.mirrored).lower()} in the camera file",
                reason="mirrored",
            )
        raise NotIdentified(
            f"no attitude explains the {len(order)} point sources better than chance ({search.tried} tried; "
            f"{refusal}): is the camera file right, and is this the night sky?",
            detected=len(order),
            tried=search.tried,
        )

    def _first(
        self, attitudes: Iterable[Turned], seen: _Seen, search: AttitudeSearch
    ) -> tuple[Identification | None, str]:
        """The first of the attitudes that names enough stars, or why the last one did not."""
        refusal = "no triangle of stars is the catalogue's"
        refiner = Refiner(seen.camera, seen.detections, seen.rays_cam, seen.variance_px2, seen.patterns)
        for refined, turned in enumerate(attitudes):
            if refined == MOST_REFINED:
                break
            found = refiner(turned)
            if found is None:
                continue
            try:
                return self._named(found, seen, search.tried), ""
            except _RoughCamera:
                raise
            except NotIdentified as cause:
                refusal = str(cause)
        return None, refusal

    def _named(self, found: Found, seen: _Seen, tried: int) -> Identification:
        """The matches, judged by the odds that chance would give as many; NotIdentified if it might."""
        pairs = found.pairs
        distance = pairs.distance_px[found.matched]
        own = distance[found.named]
        if len(own) < FEWEST_MATCHES:
            raise NotIdentified(f"only {len(own)} stars match", matched=len(own))
        rms_px = float(np.sqrt(0.5 * (own @ own) / len(own)))
        radius_px = min(FIRST_GATE_PX, max(3.0 * rms_px, SMALLEST_RADIUS_PX))
        hits = int(np.count_nonzero(distance < radius_px))
        log_chance = self._log_chance(found, hits, radius_px, seen, tried)
        if self.whole_field:
            _refuse_rough_camera(found.on_place[pairs.detection[found.matched] < BRIGHT_DETECTIONS])
        named = pairs.plain(
            found.matched[found.named], found.variance_px2[found.named], BLEND_SIGMAS * seen.detections.psf_sigma_px
        )
        return Identification(
            detection=seen.order[pairs.detection[named]],
            star=pairs.star[named],
            R_cam_icrs=found.R_cam_icrs,
            false_alarm_probability=float(np.exp(max(log_chance, -690.0))),
            unexplained=pairs.unexplained(seen.detections.snr, ON_PLACE_PX) + seen.outside,
        )

    def _log_chance(self, found: Found, hits: int, radius_px: float, seen: _Seen, tried: int) -> float:
        """Log of the probability that chance gives as many hits; NotIdentified where that is not small enough."""
        radius_rad = radius_px * seen.scale.on_axis
        expected = np.array(max(int(len(found.visible_v_mag) * seen.scale.part_of_circle), hits))
        chance = ChanceModel(seen.rays_cam, min(LOCAL_PART * seen.scale.diameter_rad, WIDEST_NEIGHBOURHOOD_RAD))
        alikes = alike(found.visible_v_mag, found.pairs.light.measured_mag, DIMMED_MAG)
        log_chance = float(chance.log_odds(np.array(hits), expected, radius_rad, alike=alikes)) + float(np.log(tried))
        if log_chance > np.log(self.max_false_alarm):
            raise NotIdentified(f"the {hits} stars that match might do so by chance", matched=hits)
        return log_chance


class _Seen:
    """The detections inside the image circle, and what they are seen with."""

    def __init__(
        self, detections: Detections, order: Ints, rays_cam: Array, patterns: Patterns, camera: Camera, scale: Scale
    ) -> None:
        all_inside = len(order) == len(detections)
        self.detections = detections if all_inside else taken(detections, order)
        self.outside = 0
        if not all_inside:
            self.outside = int(np.count_nonzero(np.delete(detections.snr, order) > SIGNIFICANT_SNR))
        self.order, self.rays_cam, self.patterns, self.camera, self.scale = order, rays_cam, patterns, camera, scale
        covariance = self.detections.covariance_px2
        self.variance_px2 = 0.5 * (covariance[:, 0, 0] + covariance[:, 1, 1])  # mean of both axes

    def mirrored(self) -> _Seen:
        """The same through a camera of the other hand."""
        camera = replace(self.camera, mirrored=not self.camera.mirrored)
        rays_cam = camera.unproject(self.detections.xy_px)
        other = _Seen(self.detections, np.arange(len(rays_cam)), rays_cam, self.patterns, camera, self.scale)
        return other


class _RoughCamera(NotIdentified):
    """The sky is found, but the camera file's lens is not this one."""


def _refuse_rough_camera(on_place: Bools) -> None:
    """Raise where many of the bright stars lie near, but not on their places (n,).

    Such a camera file fits a patch of the sky, and turns the attitude to suit it: 1 % of focal length is 0.8 degrees.
    """
    on, near = int(np.count_nonzero(on_place)), len(on_place)
    if on < ON_PLACE * near - 3.0 * np.sqrt(ON_PLACE * (1 - ON_PLACE) * near):
        raise _RoughCamera(
            f"only {on} of {near} bright stars lie within {ON_PLACE_PX:g} px of where the camera file puts "
            f"them, the others up to {GATE_PX:g} px off: it is not the calibration of this lens",
            matched=on,
        )
