"""Identification with a camera file, with or without a rough attitude: which detection is which catalogue star."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from math import log, sqrt

import numpy as np

from startrack.camera import Camera
from startrack.core.types import Array, Centroids, Identification, NotIdentified, Stars
from startrack.estimation.false_alarm import (
    CAP_RADIUS_RAD,
    coincidence_probability,
    density_per_sr,
    log_p_value,
    log_trials,
    probability,
)
from startrack.estimation.match import DIMMED_MAG, SIGNIFICANT_SNR, upper_median
from startrack.identification.attitude_refinement import AttitudeMatch, agreement_of, refine_attitude
from startrack.identification.attitude_search import (
    FIRST_GATE_PX,
    GATE_PX,
    INLIER_PX,
    ONE_SOURCE_SIGMAS,
    AttitudeHypothesis,
    AttitudeSearch,
    Sources,
)
from startrack.identification.index import patterns_of, pixel_scale_of
from startrack.identification.lens_view import UNKNOWN_LENS
from startrack.identification.near_sky import NearSky

MAX_FALSE_ALARM = 1e-9  # probability that chance gives an accepted identification
BRIGHT_DETECTIONS = 300  # brightest detections that decide whether the camera file is right
INLIER_FRACTION = 0.7  # of the stars within GATE_PX that lie within INLIER_PX if the camera file is right
MAX_REFINED = 40
TOLERANCE_SIGMAS = 3.0
SMALLEST_RADIUS_PX = INLIER_PX / TOLERANCE_SIGMAS
LOCAL_FRACTION = 0.1  # of the field's diameter: radius of the caps in which the density of detections is measured


@dataclass(frozen=True)
class Identifier:
    """Identification by triangles, accepted by its p-value: (Centroids, Camera, Stars, attitude) -> Identification.

    An attitude is accepted if chance would give as many coincidences with a probability below `max_false_alarm`, all
    hypotheses tried included; otherwise NotIdentified is raised. With `near_sky` only attitudes that point into that
    part of the sky are tried: fewer trials, so fewer stars suffice.
    """

    max_false_alarm: float = MAX_FALSE_ALARM
    tolerances_px: tuple[float, float] = (0.7, 3.0)  # error of a ray: centroids alone; rough calibration included
    whole_field: bool = True  # refuse a camera that fits only a part of its field; a calibration may begin with one
    near_sky: NearSky | None = None

    def __call__(
        self, centroids: Centroids, camera: Camera, stars: Stars, near_R_cam_icrs: Array | None = None
    ) -> Identification:
        """Match `centroids` of a `camera` with the `stars`, both sorted, brightest first.

        A rough attitude `near_R_cam_icrs` (3, 3) is tried first; where it is wrong, the others follow.
        Raises NotIdentified; its reason is "mirrored" where only the mirror image of the frame can be identified.
        """
        scale = pixel_scale_of(camera)
        rays_cam = camera.unproject(centroids.xy_px)
        inside = np.flatnonzero(rays_cam[:, 2] >= np.cos(camera.max_angle_rad))
        is_whole = len(inside) == len(centroids)
        some, rays_inside = (centroids, rays_cam) if is_whole else (centroids.take(inside), rays_cam[inside])
        sources = Sources(some, rays_inside, camera, scale, patterns_of(stars, scale.field_sr), self.near_sky)
        if len(inside) < sources.min_matches:
            fact, advice = _describe_few(len(inside), len(centroids), camera, sources.min_matches)
            raise NotIdentified(fact, advice=advice, detected=len(inside))
        search = AttitudeSearch(sources)
        tolerance_px, rough_px = self.tolerances_px
        tolerance_px = min(max(tolerance_px, TOLERANCE_SIGMAS * upper_median(sources.variance_px2) ** 0.5), rough_px)
        found = None
        if near_R_cam_icrs is not None and (self.near_sky is None or self.near_sky.contains(near_R_cam_icrs)):
            with suppress(WrongCamera):  # or a wrong attitude
                found, _ = self._find_accepted(search, search.hypotheses_near(near_R_cam_icrs, tolerance_px))
        if found is None:
            found, refusal = self._find_accepted(search, search.hypotheses(tolerance_px, rough_px))
        if found is not None:
            if is_whole:
                return found
            outside = int(np.count_nonzero(np.delete(centroids.snr, inside) > SIGNIFICANT_SNR))
            return replace(found, detection=inside[found.detection], unexplained=found.unexplained + outside)
        mirror, lenient = AttitudeSearch(sources.mirror_image()), replace(self, whole_field=False)
        if lenient._find_accepted(mirror, mirror.hypotheses(tolerance_px, rough_px))[0] is not None:
            raise NotIdentified(
                "the image is a mirror image, compared with the camera file",
                reason="mirrored",
                advice="is the array transposed? Else flip the image, or set mirrored = "
                f"{str(not camera.mirrored).lower()} in the camera file",
            )
        where, advice = "", ""
        if self.near_sky is not None:
            where, advice = f" within {self.near_sky}", "; if the axis may point elsewhere, leave out near_sky"
        lens = "if its lens may differ from that of the others, try it alone"
        if camera.name != UNKNOWN_LENS:
            lens = f"if {camera.name} may be another lens's, try startrack identify --fov, which needs no camera file"
        raise NotIdentified(
            f"no attitude{where} explains the {len(inside)} point "
            f"sources better than chance ({search.tried} tried; {refusal})",
            advice=lens + advice,
            detected=len(inside),
            tried=search.tried,
        )

    def _find_accepted(
        self, search: AttitudeSearch, hypotheses: Iterable[AttitudeHypothesis]
    ) -> tuple[Identification | None, str]:
        """The first hypothesis that is accepted, or why the last one was not."""
        refusal = "no triangle of detections matches one of the catalogue"
        for refined, hypothesis in enumerate(hypotheses):
            if refined == MAX_REFINED:
                break
            match = refine_attitude(search.sources, hypothesis)
            if match is None:
                continue
            try:
                return self._accept_match(match, search.sources, search.tried), ""
            except WrongCamera:
                raise
            except NotIdentified as cause:
                refusal = str(cause)
        return None, refusal

    def _accept_match(self, match: AttitudeMatch, sources: Sources, tried: int) -> Identification:
        """The identification of a match; NotIdentified if chance might explain it, or if the camera file is wrong."""
        pairs = match.pairs
        distance = pairs.distance_px[match.matched]
        named_distance = distance[match.named]
        if len(named_distance) < sources.min_matches:
            raise NotIdentified(f"only {len(named_distance)} stars match", matched=len(named_distance))
        rms_px = sqrt(0.5 * (named_distance @ named_distance) / len(named_distance))
        radius_px = min(FIRST_GATE_PX, max(TOLERANCE_SIGMAS * rms_px, SMALLEST_RADIUS_PX))
        hits = int(np.count_nonzero(distance < radius_px))
        log_p = self._log_p_value(match, hits, radius_px, sources) + log_trials(tried, sources.sky_part)
        if log_p > log(self.max_false_alarm):
            raise NotIdentified(f"the {hits} stars that match might do so by chance", matched=hits)
        if self.whole_field:
            # A camera that fits only a part of the field biases the attitude: by 0.8 degrees for 1 % of focal length.
            bright = match.inlier[pairs.detection[match.matched] < BRIGHT_DETECTIONS]
            inliers, near = int(np.count_nonzero(bright)), len(bright)
            if inliers < INLIER_FRACTION * near - 3.0 * sqrt(INLIER_FRACTION * (1 - INLIER_FRACTION) * near):
                raise WrongCamera(
                    f"only {inliers} of {near} bright stars lie within {INLIER_PX:g} px of where the camera file puts "
                    f"them, the others up to {GATE_PX:g} px off: it is not the calibration of this lens",
                    matched=inliers,
                )
        named = pairs.select_unambiguous(
            match.matched[match.named],
            match.variance_px2[match.named],
            ONE_SOURCE_SIGMAS * sources.centroids.psf_sigma_px,
        )
        return Identification(
            detection=pairs.detection[named],
            star=pairs.star[named],
            R_cam_icrs=match.R_cam_icrs,
            false_alarm_probability=probability(log_p),
            unexplained=pairs.count_unexplained(sources.centroids.snr, INLIER_PX),
        )

    def _log_p_value(self, match: AttitudeMatch, hits: int, radius_px: float, sources: Sources) -> float:
        """Log-probability that chance gives as many hits at one attitude."""
        radius_rad = radius_px * sources.scale.axis_rad_per_px
        predicted = max(int(len(match.visible_v_mag) * sources.scale.frame_fraction), hits)
        local = density_per_sr(sources.rays_cam, min(LOCAL_FRACTION * sources.scale.diameter_rad, CAP_RADIUS_RAD))
        density = max(local, len(sources.rays_cam) / sources.scale.field_sr)  # caps about few detections hold no others
        agreement = agreement_of(sources.centroids, match.visible_v_mag, match.pairs.scale.measured_mag, DIMMED_MAG)
        each = agreement * coincidence_probability(density * np.pi * radius_rad**2)
        return float(log_p_value(hits, predicted, each))


def _describe_few(inside: int, given: int, camera: Camera, needed: int) -> tuple[str, str]:
    """Reason why the `inside` of the `given` point sources, those in the camera's image circle, are not the `needed`.

    The advice comes second.
    """
    if given < needed:
        return f"{given} point source{'s' * (given != 1)}: too few to identify, which takes {needed}", (
            "try a longer exposure"
        )
    return (
        f"only {inside} of {given} point sources lie in the image circle of camera {camera.name!r} "
        f"({np.degrees(camera.max_angle_rad):.4g} degrees from its axis, in {camera.size_px[0]} x "
        f"{camera.size_px[1]} px), too few to identify",
        "is it the camera file of these pixels?",
    )


class WrongCamera(NotIdentified):
    """The attitude is found, but the camera file is not the calibration of this lens."""
