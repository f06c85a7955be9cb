"""Lost in space: which detection is which star, with no prior on the attitude."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.camera import Camera
from startrack.identify.chance import ChanceModel
from startrack.identify.index import PatternIndex, build_index
from startrack.identify.match import Matches, match
from startrack.identify.triangles import triangles
from startrack.orient import AttitudeFit, solve_attitude, wahba
from startrack.types import Array, Detections, Identification, NotIdentified, Stars

HYPOTHESES_AT_ONCE = 256
MOST_HYPOTHESES = 60_000
VERIFICATION_STARS = 400
FEWEST_MATCHES = 6
GATES_PX = (6.0, 3.0, 1.5)
SIGNIFICANT_SNR = 10.0


@dataclass(frozen=True)
class Identifier:
    """Identifies by triangles and accepts by statistics: (Detections, Camera, Stars) -> Identification.

    An answer is accepted only where chance would produce as many coincidences with probability below
    `max_false_alarm`, all hypotheses tried included; otherwise NotIdentified is raised.
    """

    max_false_alarm: float = 1e-9
    tolerances_px: tuple[float, ...] = (0.7, 3.0)  # error of a ray: centroids first, then a rough calibration too
    depths: tuple[int, ...] = (30, 60, 120, 240)  # brightest detections that form triangles, round by round

    def __call__(self, detections: Detections, camera: Camera, stars: Stars) -> Identification:
        """Matches in the frame. `stars` are sorted, brightest first. Raises NotIdentified (or reason mirrored)."""
        try:
            return self._identify(detections, camera, stars)
        except NotIdentified:
            if self._solves(detections, replace(camera, mirrored=not camera.mirrored), stars):
                raise NotIdentified(
                    "the image is a mirror image of what the camera file says: flip the image, or set mirrored = "
                    f"{str(not camera.mirrored).lower()} in the camera file",
                    reason="mirrored",
                ) from None
            raise

    def _solves(self, detections: Detections, camera: Camera, stars: Stars) -> bool:
        try:
            self._identify(detections, camera, stars)
        except NotIdentified:
            return False
        return True

    def _identify(self, detections: Detections, camera: Camera, stars: Stars) -> Identification:
        known = camera.angle_rad(detections.xy_px) <= camera.max_angle_rad
        order = np.flatnonzero(known)
        if len(order) < FEWEST_MATCHES:
            few = f"{len(order)} point sources are too few to identify: expose longer"
            raise NotIdentified(few, detected=len(order))
        rays = camera.unproject(detections.xy_px[order])
        index = build_index(stars, _field_sr(camera))
        search = _Search(camera, rays, stars, index, np.log(self.max_false_alarm))
        for tolerance_px in self.tolerances_px:
            found = search.run(tolerance_px, self.depths)
            if found is not None:
                R, log_chance = found
                return self._confirmed(detections, camera, stars, R, log_chance)
        raise NotIdentified(
            f"no attitude explains the {len(order)} point sources better than chance "
            f"({search.tested} tried): is the camera file right, and is this the night sky?",
            detected=len(order),
            tried=search.tested,
        )

    def _confirmed(
        self, detections: Detections, camera: Camera, stars: Stars, R: Array, log_chance: float
    ) -> Identification:
        """The matches after refinement, judged once more at their own, much smaller radius."""
        fit, matches = _refined(detections, camera, stars, R)
        detection, star = matches.detection[fit.used], matches.star[fit.used]
        if len(star) < FEWEST_MATCHES:
            raise NotIdentified(f"only {len(star)} stars match after refinement", matched=len(star))
        return Identification(
            detection=detection,
            star=star,
            R_cam_icrs=fit.attitude.R_cam_icrs,
            false_alarm_probability=float(np.exp(max(log_chance, -690.0))),
            unexplained=_unexplained(detections, camera, stars, fit.attitude.R_cam_icrs, matches.zero_mag),
        )


def _field_sr(camera: Camera) -> float:
    """Solid angle [sr] that the camera sees: of the image circle, or of the frame where that is smaller."""
    width, height = camera.size_px
    x, y = np.meshgrid(np.linspace(0, width - 1, 33), np.linspace(0, height - 1, 33))
    angle = camera.angle_rad(np.stack([x, y], axis=-1))
    cell = width * height / angle.size
    lit = angle < camera.max_angle_rad
    return float(np.sum(camera.pixel_solid_angle_sr(angle[lit]) * cell))


class _Search:
    """Hypotheses from matching triangles, and their verification against the bright stars."""

    def __init__(
        self, camera: Camera, rays_cam: Array, stars: Stars, index: PatternIndex, log_max_false_alarm: float
    ) -> None:
        self.camera, self.rays_cam, self.index = camera, rays_cam, index
        self.bright_icrs = stars.rays_icrs[index.star[: max(VERIFICATION_STARS, len(index.star) // 2)]]
        self.log_max_false_alarm = log_max_false_alarm
        self.tested = 0
        centre = camera.unproject(np.array([camera.centre_px]))[0]
        self.scale_rad = float(camera.mean_scale_rad_per_px(np.arccos(np.clip(centre[2], -1, 1)) + 0.01))

    def run(self, tolerance_px: float, depths: tuple[int, ...]) -> tuple[Array, float] | None:
        """The first attitude that chance cannot explain, with its log false-alarm probability."""
        tolerance = tolerance_px * self.scale_rad
        done = 0
        for depth in depths:
            if depth > done and len(self.rays_cam) > done:
                found = self._round(tolerance, done, depth)
                if found is not None or self.tested > MOST_HYPOTHESES:
                    return found
            done = depth
        return None

    def _round(self, tolerance_rad: float, done: int, depth: int) -> tuple[Array, float] | None:
        image = triangles(self.rays_cam[:depth], self.index.reach_rad)
        fresh = image.vertices.max(axis=1, initial=0) >= done
        image = replace(
            image, vertices=image.vertices[fresh], sides_rad=image.sides_rad[fresh], handed=image.handed[fresh]
        )
        left, right = self.index.candidates(image, tolerance_rad)
        mismatch = np.abs(image.sides_rad[left] - self.index.triangles.sides_rad[right]).max(axis=1)
        order = np.argsort(mismatch / image.sides_rad[left, 0], kind="stable")
        seen = ChanceModel(self.rays_cam[: 4 * depth])
        for start in range(0, len(order), HYPOTHESES_AT_ONCE):
            chunk = order[start : start + HYPOTHESES_AT_ONCE]
            cam = self.rays_cam[image.vertices[left[chunk]]]
            icrs = self.index.rays_icrs[self.index.triangles.vertices[right[chunk]]]
            R = wahba(cam, icrs, np.ones(cam.shape[:2]))
            self.tested += len(chunk)
            found = self._best(R, seen, 2.0 * tolerance_rad)
            if found is not None:
                return found
            if self.tested > MOST_HYPOTHESES:
                return None
        return None

    def _best(self, R: Array, seen: ChanceModel, radius_rad: float) -> tuple[Array, float] | None:
        predicted = self.bright_icrs @ np.swapaxes(R, 1, 2)  # (hypotheses, stars, 3) in cam
        inside = self._inside(predicted)
        distance = np.full(inside.shape, np.inf)
        distance[inside], _ = seen.tree.query(predicted[inside], distance_upper_bound=2 * np.sin(radius_rad / 2))
        hits = np.isfinite(distance).sum(axis=1)
        log_chance = seen.log_odds(hits, inside.sum(axis=1), radius_rad) + np.log(max(self.tested, 1))
        best = int(np.argmin(log_chance))
        if log_chance[best] > self.log_max_false_alarm or hits[best] < FEWEST_MATCHES:
            return None
        return R[best], float(log_chance[best])

    def _inside(self, rays_cam: Array) -> Array:
        angle_in = rays_cam[..., 2] > np.cos(self.camera.max_angle_rad)
        inside = np.zeros(angle_in.shape, dtype=bool)
        inside[angle_in] = self.camera.project(rays_cam[angle_in])[1]
        return inside


def _refined(detections: Detections, camera: Camera, stars: Stars, R: Array) -> tuple[AttitudeFit, Matches]:
    """Attitude and matches, gate by gate."""
    blend_px = 3.0 * detections.psf_sigma_px
    for gate_px in (*GATES_PX, GATES_PX[-1]):
        matches = match(detections, camera, stars, R, gate_px, blend_px)
        if len(matches.star) < FEWEST_MATCHES:
            raise NotIdentified(f"only {len(matches.star)} stars match", matched=len(matches.star))
        d = matches.detection
        fit = solve_attitude(
            camera, detections.xy_px[d], detections.covariance_px2[d], stars.rays_icrs[matches.star], R
        )
        R = fit.attitude.R_cam_icrs
    return fit, matches


def _unexplained(detections: Detections, camera: Camera, stars: Stars, R: Array, zero_mag: float) -> int:
    """Significant detections with no catalogue star near that could be a part of their light."""
    from scipy.spatial import cKDTree

    significant = np.flatnonzero(detections.snr > SIGNIFICANT_SNR)
    if not len(significant):
        return 0
    faintest = zero_mag - 2.5 * np.log10(detections.flux_e[significant].min()) + 2.0
    px, inside = camera.project(stars.rays_icrs[: int(np.searchsorted(stars.v_mag, faintest))] @ R.T)
    if not inside.any():
        return len(significant)
    distance, _ = cKDTree(px[inside]).query(detections.xy_px[significant], distance_upper_bound=GATES_PX[-1])
    return int(np.count_nonzero(~np.isfinite(distance)))
