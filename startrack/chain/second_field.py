"""A second star field in the frame, at another attitude: the camera turned between two parts of the exposure.

The significant point sources that the first attitude does not explain are identified by themselves, with the same odds
against chance. What is found is a second exposure, unless it is a ghost (a reflection in the lens), or a part of the
image that came from another one.

A ghost is faint. Bare silicon reflects 35 % of the light and a cover glass without coatings 8 % back onto it: 3 %. A
part p of the exposure shows its stars with p / (1 - p) of the light of the others. Rendered ghosts of 10 and
30 % were measured with 10 and 28 %, second parts of 30 % with 41 %, of 50 % with 80 to 97 %.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.camera import Camera
from startrack.core.types import Centroids, Identification, NotIdentified, NotLocated, Stars
from startrack.estimation.match import SIGNIFICANT_SNR
from startrack.identification import INLIER_PX, MIN_MATCHES, Identifier

LEAST_UNEXPLAINED = 2 * MIN_MATCHES  # significant sources; untouched frames have 0 to 4
# Of them, to the identified stars: second exposures of 30 to 50 % had 0.11 to 0.39, ghosts to 0.015.
LEAST_UNEXPLAINED_PART = 0.03
LEAST_STARS = 8  # of a second field
FAINTER_MAG = 1.0  # predicted stars fainter than the faintest identified one explain sources, too
MOST_SOURCES = 150  # brightest ones that are identified
LEAST_TURN_PX = 2 * INLIER_PX  # of the stars: below it both images of a star are one source
LEAST_RATIO = 0.35  # of the light of the fainter field to that of the other one
LEAST_INTERLEAVED = 0.25  # of the second field beside stars of the first: second exposures 0.39 to 1, strips to 0.15


@dataclass(frozen=True)
class SecondField:
    """A second field of stars."""

    stars: int  # identified
    turn_rad: float  # between both attitudes
    shift_px: float  # by which its stars are displaced, the median
    ratio: float  # of light at equal magnitude, that of the fainter field to that of the other
    interleaved: float  # part of its stars beside which a star of the first field is seen

    @property
    def is_exposure(self) -> bool:
        """Whether it is a part of the exposure, rather than a ghost or a part of the image from another one."""
        return self.ratio > LEAST_RATIO and self.shift_px > LEAST_TURN_PX and self.interleaved > LEAST_INTERLEAVED


def check_single_field(centroids: Centroids, camera: Camera, stars: Stars, first: Identification) -> None:
    """Raise NotLocated (inconsistent_evidence) where the frame has a second star field as bright as the first.

    `first` has the matches of the `centroids` with the `stars`, and the attitude of the `camera`, right to a pixel.
    """
    found = find_second_field(centroids, camera, stars, first)
    if found is not None and found.is_exposure:
        raise NotLocated(
            f"two star fields in one frame, turned by {np.degrees(found.turn_rad):.1f} degrees against each other: "
            f"{len(first)} stars show one attitude and {found.stars} others, {100 * found.ratio:.0f} % as bright for "
            "their magnitudes, another: did the camera turn during the exposure, or are these two pictures in one?",
            reason="inconsistent_evidence",
        )


def find_second_field(centroids: Centroids, camera: Camera, stars: Stars, first: Identification) -> SecondField | None:
    """The star field among the sources that an attitude leaves unexplained; None where there is none.

    `first` has the matches of the `centroids` with the `stars`, and the attitude of the `camera`.
    """
    from scipy.spatial import cKDTree

    if first.unexplained < max(LEAST_UNEXPLAINED, LEAST_UNEXPLAINED_PART * len(first)):
        return None
    predicted_px, inside = camera.project(stars.rays_icrs @ first.R_cam_icrs.T)
    seen = np.flatnonzero(inside & (stars.v_mag < float(stars.v_mag[first.star].max()) + FAINTER_MAG))
    distance, _ = cKDTree(predicted_px[seen]).query(centroids.xy_px, distance_upper_bound=INLIER_PX)
    unexplained = np.isinf(distance) & (centroids.snr > SIGNIFICANT_SNR)
    unexplained[first.detection] = False
    left = np.flatnonzero(unexplained)[:MOST_SOURCES]
    if len(left) < LEAST_UNEXPLAINED:
        return None
    sources = centroids.take(left)
    try:
        second = Identifier(whole_field=False)(sources, camera, stars)
    except NotIdentified:
        return None
    if len(second) < LEAST_STARS:
        return None
    turn = second.R_cam_icrs @ first.R_cam_icrs.T
    xy_px = sources.xy_px[second.detection]
    shift_px = np.linalg.norm(xy_px - predicted_px[second.star], axis=1)
    # The nearest bright stars of the first field: identified ones, where both fields lie in one another.
    bright = np.flatnonzero(inside & (stars.v_mag < np.median(stars.v_mag[first.star])))
    _, nearest = cKDTree(predicted_px[bright]).query(xy_px)
    light = _light(sources, camera, stars, second) / _light(centroids, camera, stars, first)
    return SecondField(
        stars=len(second),
        turn_rad=float(np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0))),
        shift_px=float(np.median(shift_px)),
        ratio=min(light, 1.0 / light),
        interleaved=float(np.mean(np.isin(bright[nearest], first.star))),
    )


def _light(sources: Centroids, camera: Camera, stars: Stars, found: Identification) -> float:
    """Median light [e] of the stars found, for a star of magnitude 0 on the axis."""
    clear = ~sources.saturated[found.detection]
    some = clear if clear.any() else ~clear
    detection, star = found.detection[some], found.star[some]
    throughput = 1.0 if camera.sensor is None else camera.sensor.throughput(camera.angle_rad(sources.xy_px[detection]))
    light = sources.flux_e[detection] / np.maximum(throughput, 1e-3)
    return float(np.median(light * 10 ** (0.4 * stars.v_mag[star])))
