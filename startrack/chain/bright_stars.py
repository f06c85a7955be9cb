"""Names of bright stars and planets, whose flat tops no fit of a point source describes, once the attitude is known.

They count neither for the attitude nor as evidence. A bright blob gets the name of a star that lies beneath it, if it
has a star's shape and that star's brightness, if it can be no other star and no planet, and if chance would hardly put
a blob there.
"""

from __future__ import annotations

from datetime import datetime
from typing import NamedTuple

import numpy as np

from startrack.camera import Camera
from startrack.catalog import bodies_from_centre
from startrack.chain.stages import NamedStars, SourceNames, identified_names
from startrack.core.types import Array, Body, Bools, Detections, Identification, Ints, Stars
from startrack.detection import disc_px, find_blobs, light_at
from startrack.estimation.false_alarm import coincidence_probability
from startrack.estimation.match import BRIGHTER_MAG, DIMMED_MAG, DISTINCT_MAG, SIGNIFICANT_SNR
from startrack.identification import coincidence_radius_px

ALIKE = 7  # named stars of nearly one magnitude, whose median light is that of such a star
MOST_CHANCE_NAMES = 0.03  # expected number of stars as bright, of those without a name, that have a blob by chance
PARALLAX_RAD = {"earth": np.radians(1.03), "moon": np.radians(0.28)}  # largest, of the other as seen from its surface
HALF_PIXEL_PX = 0.5  # from the centre to the edge
LOCAL_PART = 0.05  # of the frame's longer side: radius within which other blobs are counted


class _FoundBodies(NamedTuple):
    """Bodies that have a source, and the detections and blobs at their places."""

    seen: tuple[Body, ...]
    detection: Ints  # of these, without those of brighter stars
    blob: Ints  # of all bodies that are as bright as the stars sought


class _BrightSources:
    """The sources of an image at its attitude, and the light of the stars that the identification names."""

    def __init__(self, sources: Detections, camera: Camera, stars: Stars, known: Identification, R_cam_icrs: Array):
        from scipy.spatial import cKDTree

        self.sources, self.camera, self.stars, self.known, self.R_cam_icrs = sources, camera, stars, known, R_cam_icrs
        self.known_px = sources.xy_px[known.detection]
        self.source_mag = np.full(len(sources), np.inf)  # of the star that each source is; inf: none
        self.source_mag[known.detection] = stars.v_mag[known.star]
        predicted_px, _ = camera.project(stars.rays_icrs[known.star] @ R_cam_icrs.T)
        self.radius_px = coincidence_radius_px(np.hypot(*(predicted_px - self.known_px).T))
        self.blobs = find_blobs(sources)
        self.area_px = np.bincount(self.blobs.blob, minlength=len(self.blobs))
        self.tree = cKDTree(self.blobs.pixels)
        self.source_blob = self.blob_at(sources.xy_px)
        order = np.argsort(stars.v_mag[known.star], kind="stable")
        self.known_mag = stars.v_mag[known.star[order]]
        self.known_light_e = light_at(sources, self.known_px[order])
        self.known_blob = self.source_blob[known.detection[order]]

    def blob_at(self, xy_px: Array) -> Ints:
        """The blob (n,) nearest to each place (n, 2), -1 where no pixel's edge is within the radius of coincidence."""
        apart_px, pixel = self.tree.query(xy_px, distance_upper_bound=self.radius_px + HALF_PIXEL_PX)
        near = np.isfinite(apart_px)
        found = np.full(len(xy_px), -1)
        found[near] = self.blobs.blob[pixel[near]]
        return found

    def light_bounds(self, v_mag: Array) -> tuple[Array, Array]:
        """Least and most light (n,) [e] of stars of `v_mag` (n,): named ones DIMMED_MAG fainter, BRIGHTER_MAG brighter.

        Where stars saturate light grows less than in proportion to the flux; in proportion it is a bound.
        """
        least, _ = self._alike(v_mag + DIMMED_MAG)
        light, mag = self._alike(v_mag - BRIGHTER_MAG)
        most = light * 10.0 ** (0.4 * np.maximum(mag - (v_mag - BRIGHTER_MAG)[:, None], 0.0))
        return np.median(least, axis=1), np.median(most, axis=1)

    def _alike(self, v_mag: Array) -> tuple[Array, Array]:
        """Light [e] and magnitudes, both (n, ALIKE), of the named stars about each of `v_mag` (n,)."""
        first = np.clip(np.searchsorted(self.known_mag, v_mag) - ALIKE // 2, 0, len(self.known_mag) - ALIKE)
        which = first[:, None] + np.arange(ALIKE)
        return self.known_light_e[which], self.known_mag[which]

    @property
    def depth_mag(self) -> float:
        """Magnitude down to which half of the named stars and more have a blob; at least that of the brightest one."""
        part = np.cumsum(self.known_blob >= 0) / np.arange(1, len(self.known_blob) + 1)
        return float(self.known_mag[np.flatnonzero(part >= 0.5)[-1:]].max(initial=self.known_mag[0]))

    def find_bodies(self, bodies: tuple[Body, ...], parallax_rad: float) -> _FoundBodies:
        """Bodies among `bodies` that have a source: a blob, or a detection, with the light of a star as bright.

        The directions of Moon and Earth are known to `parallax_rad`.
        """
        seen, detection, blob = [], [self.known.detection[:0]], [self.known_blob[:0]]
        scale = float(self.camera.mean_scale_rad_per_px(np.array(self.camera.calibrated_angle_rad / 2)))
        for body in bodies:
            px, in_view = self.camera.project(self.R_cam_icrs @ body.ray_icrs)
            if not in_view:
                continue
            at, is_large = self._blobs_of_body(px, parallax_rad / scale if body.name in ("Moon", "Earth") else 0.0)
            near = self._detections_of_body(body, px, at)
            light_e = [*light_at(self.sources, self.sources.xy_px[near]), *self.blobs.light_e[at]]
            if is_large or max(light_e, default=0.0) > self.light_bounds(np.array([body.v_mag]))[0][0]:
                seen.append(body)
                detection.append(near)
            if body.v_mag < self.depth_mag + DISTINCT_MAG:
                blob.append(at)
        return _FoundBodies(tuple(seen), np.concatenate(detection), np.concatenate(blob))

    def _blobs_of_body(self, px: Array, moved_px: float) -> tuple[Ints, bool]:
        """The blobs (n,) at the place (2,) of a body, and whether one is larger than any star, as that of the Moon.

        The body is up to `moved_px` from that place. Stars may be about it then: only large blobs count.
        """
        found = np.unique(self.blobs.blob[self.tree.query_ball_point(px, self.radius_px + moved_px + HALF_PIXEL_PX)])
        is_large = self.area_px[found] > len(disc_px(self.sources))  # the Moon's glare is no background
        return found[is_large] if moved_px else found, bool(is_large.any())

    def _detections_of_body(self, body: Body, px: Array, at: Ints) -> Ints:
        """The detections (n,) at the place (2,) of a body or in the blobs `at` (m,), without stars as bright."""
        is_near = (np.hypot(*(self.sources.xy_px - px).T) < self.radius_px) | np.isin(self.source_blob, at)
        return np.flatnonzero(is_near & (self.source_mag > body.v_mag))

    def name_stars(self, of_bodies: Ints) -> tuple[NamedStars, Ints]:
        """The stars without a name that are blobs, with these blobs; the blobs `of_bodies` are none."""
        blobs, v_mag = self.blobs, self.stars.v_mag
        count = int(np.searchsorted(v_mag, self.depth_mag + DISTINCT_MAG))
        star_px, in_view = self.camera.project(self.stars.rays_icrs[:count] @ self.R_cam_icrs.T)
        star_blob = np.where(in_view, self.blob_at(star_px), -1)
        is_free = self._are_free(of_bodies)
        is_clutter = is_free.copy()
        is_clutter[star_blob[star_blob >= 0]] = False
        is_named = np.zeros(len(self.stars), dtype=bool)
        is_named[self.known.star] = True
        star = self._single_stars(star_blob)
        star = star[is_free[star_blob[star]] & ~is_named[star] & (v_mag[star] <= self.depth_mag)]
        least, most = self.light_bounds(v_mag[star])
        at = star_blob[star]
        is_alike = (blobs.light_e[at] > least) & (blobs.light_e[at] < most)
        trials = np.cumsum(in_view & ~is_named[:count])[star]  # stars as bright, of those without a name
        by_chance = trials * self._chances(at, least, most, is_clutter)
        star = star[is_alike & (by_chance < MOST_CHANCE_NAMES)]
        at = star_blob[star]
        return NamedStars(star=star, xy_px=blobs.xy_px[at], saturated=blobs.saturated[at]), at

    def _are_free(self, of_bodies: Ints) -> Bools:
        """Whether each blob (n,) may be a star: it has a star's shape, and no named star and no body is there."""
        found = self.blobs.compact & (self.camera.angle_rad(self.blobs.xy_px) <= self.camera.max_angle_rad)
        found[of_bodies] = False
        found[self.known_blob[self.known_blob >= 0]] = False
        return found

    def _single_stars(self, star_blob: Ints) -> Ints:
        """The stars (n,) that are the brightest of their blob, by DISTINCT_MAG; in the order of the blobs.

        `star_blob` (m,) are the blobs of the m brightest stars, -1: none.
        """
        star, v_mag = np.flatnonzero(star_blob >= 0), self.stars.v_mag
        _, first = np.unique(star_blob[star], return_index=True)
        brightest, others = star[first], np.delete(star, first)
        second_mag = np.full(len(self.blobs), np.inf)
        np.minimum.at(second_mag, star_blob[others], v_mag[others])
        return brightest[v_mag[brightest] + DISTINCT_MAG < second_mag[star_blob[brightest]]]

    def _chances(self, at: Ints, least: Array, most: Array, clutter: Bools) -> Array:
        """Probability (n,) that a `clutter` blob with light from `least` to `most` (n,) is at a star by chance.

        It is as near to the star as the blob `at` (n,) is. The density of such blobs is that about this one, or that in
        the image circle where it is higher there.
        """
        place, light = self.blobs.xy_px[clutter], self.blobs.light_e[clutter]
        local_px = LOCAL_PART * max(self.camera.size_px)
        alike = (light > least[:, None]) & (light < most[:, None])
        near = np.hypot(*(self.blobs.xy_px[at][:, None] - place).transpose(2, 0, 1)) < local_px
        density = (1 + np.count_nonzero(alike, axis=1)) / (np.pi / 4 * min(self.camera.size_px) ** 2)
        density = np.maximum(density, np.count_nonzero(near & alike, axis=1) / (np.pi * local_px**2))
        reach_px = np.sqrt(self.area_px[at] / np.pi) + self.radius_px
        return coincidence_probability(density * np.pi * reach_px**2)


def name_bright_sources(
    sources: Detections, camera: Camera, stars: Stars, known: Identification, R_cam_icrs: Array,
    bodies: tuple[Body, ...], time_utc: datetime | None,
) -> SourceNames:  # fmt: skip
    """Names of the `sources` of an image whose `known` stars gave `R_cam_icrs` (3, 3), the brightest included.

    `bodies` are those over the site. Without one they are those at `time_utc` that have a source, as seen from the
    Earth or from the Moon, from where more of them have one.
    """
    names = identified_names(sources, known, bodies)
    if len(known) < ALIKE:
        return names
    bright = _BrightSources(sources, camera, stars, known, R_cam_icrs)
    skies = [(bodies, 0.0)]
    if not bodies and time_utc is not None:
        skies = [(bodies_from_centre(of, time_utc), PARALLAX_RAD[of]) for of in PARALLAX_RAD]
    found = [bright.find_bodies(*sky) for sky in skies]
    best = max(found, key=lambda one: len(one.seen))  # the first of equal ones
    named, at = bright.name_stars(np.unique(np.concatenate([one.blob for one in found])))
    is_nameless = names.is_nameless.copy()
    is_body = np.isin(np.arange(len(sources)), best.detection)
    of_bodies = int(np.count_nonzero(is_body & is_nameless & (sources.snr > SIGNIFICANT_SNR)))
    is_nameless[is_body | np.isin(bright.source_blob, at)] = False
    return SourceNames(
        stars=NamedStars.concatenate(names.stars.take(~is_body[known.detection]), named), bodies=bodies or best.seen,
        is_nameless=is_nameless, unexplained=max(names.unexplained - of_bodies, 0),
    )  # fmt: skip
