"""One-to-one matches of detections with predicted stars, by position and by brightness.

Three steps are common to all callers: each star takes its nearest detection within a gate; pairs of different
brightness are dropped; each detection keeps its nearest star. Two policies exist for stars that share one detection:
`match_by_brightness` drops them, `CandidatePairs.select_unambiguous` names the detection after the brightest of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from startrack.core.types import Array, Bools, Ints
from startrack.kernels.library import kernel

DEPTH_BELOW_THRESHOLD_MAG = (
    0.7  # about the faintest detections: fainter stars are not detected, brighter ones are in open sky
)
DISTINCT_MAG = 0.3  # if one of the stars that share a detection is this much brighter, the detection is named after it
DECISIVE_BLEND_NATS = 12.0  # log-likelihood ratio that decides between two positions
SIGNIFICANT_SNR = 10.0  # detections above this should have a catalogue star
MIN_UNSATURATED = 3  # for the photometric scale; below this, saturated stars are used too
SMALLEST_FLUX = 1e-9
BRIGHTER_MAG = 0.8  # a detection is at most this much brighter than its star
DIMMED_MAG = 1.6  # and at most this much fainter: haze, branches, the edge of the lens
PX_PER_MAG = 0.6  # distance with the same cost as a difference of one magnitude


def instrumental_mag(flux: Array) -> Array:
    """Magnitudes (n,), -2.5 log10 of fluxes (n,) in any unit; fluxes that are not positive count as very faint."""
    return np.asarray(-2.5 * np.log10(np.maximum(flux, SMALLEST_FLUX)))


def upper_median(values: Array) -> float:
    """The upper median of values (n,), in a third of the time of numpy.median."""
    return float(np.sort(values)[len(values) // 2])


def select_closest(detection: Ints, distance: Array) -> Ints:
    """Ascending indices into the pairs (n,) of the pair with the smallest distance for each detection."""
    order = np.lexsort((distance, detection))
    return np.sort(order[np.flatnonzero(np.diff(detection[order], prepend=-1))])


def match_nearest(tree: Any, px: Array, gate_px: float) -> tuple[Ints, Ints, Array]:
    """Detections, stars and distances [px] (k,), one-to-one: of the stars nearest to a detection the closest one.

    `tree`: cKDTree of the detections' pixels. `px` (n, 2): predicted pixels. Pairs are sorted by detection.
    """
    distance, detection = tree.query(px, distance_upper_bound=gate_px)
    star = np.flatnonzero(np.isfinite(distance))
    star = star[np.lexsort((distance[star], detection[star]))]
    star = star[np.flatnonzero(np.diff(detection[star], prepend=-1))]
    return detection[star].astype(np.int64), star, distance[star]


def match_mutual(xy_px: Array, star_px: Array, gate_px: float) -> tuple[Ints, Ints]:
    """Indices (k,), (k,) of detections `xy_px` (n, 2) and stars `star_px` (m, 2), each other's nearest within the gate.

    Sorted by star.
    Stricter than `match_nearest`: a detection whose nearest star belongs to another detection stays unmatched.
    """
    from scipy.spatial import cKDTree

    distance, detection = cKDTree(xy_px).query(star_px, distance_upper_bound=gate_px)
    _, back = cKDTree(star_px).query(xy_px, distance_upper_bound=gate_px)
    star = np.flatnonzero(np.isfinite(distance))
    star = star[back[detection[star]] == star]
    return detection[star].astype(np.int64), star


def match_by_brightness(
    tree: Any, px: Array, star: Ints, gate_px: float, *, star_mag: Array, star_sigma_mag: Array, detection_mag: Array,
    saturated: Bools, limit_mag: float, tolerance_mag: float,
) -> tuple[Ints, Ints, Array]:  # fmt: skip
    """Detections, stars and distances [px] (k,) of the nearest pairs of equal brightness, one-to-one, with blends.

    `px` (m, 2): predicted pixels of the catalogue; `star` (n,): its stars in the frame. `star_mag`, `star_sigma_mag`
    (m,) and `detection_mag` (d,) are on one scale. Stars fainter than `limit_mag` are not matched. A saturated
    detection may be fainter than its star by any amount.
    """
    star = star[star_mag[star] < limit_mag]
    distance, nearest = tree.query(px[star], distance_upper_bound=gate_px)
    hit = np.isfinite(distance)
    star, detection, distance = star[hit], nearest[hit], distance[hit]
    fainter = star_mag[star] - detection_mag[detection]
    agree = np.abs(fainter) < np.hypot(tolerance_mag, 2.0 * star_sigma_mag[star])
    agree |= saturated[detection] & (fainter < 0)
    star, detection, distance = star[agree], detection[agree], distance[agree]
    keep = select_closest(detection, distance)
    return detection[keep], star[keep], distance[keep]


def is_isolated(
    at_px: Array, star: Ints, px: Array, seen: Ints, mag: Array, radius_px: float, blend_mag: float
) -> Bools:
    """Whether no other star of comparable brightness is predicted within the radius of the pixels `at_px` (k, 2).

    `star` (k,): the star matched there. `px` (m, 2), `mag` (m,): the catalogue; `seen` (n,): its stars in the frame.
    """
    from scipy.spatial import cKDTree

    alone = np.ones(len(star), dtype=bool)
    if not len(star):
        return alone
    seen = seen[mag[seen] < mag[star].max() + blend_mag]
    tree, others = (cKDTree(one, balanced_tree=False) for one in (at_px, px[seen]))  # made in half the time
    near = tree.sparse_distance_matrix(others, radius_px, output_type="ndarray")
    at, other = near["i"], seen[near["j"]]
    alone[at[(other != star[at]) & (mag[other] < mag[star[at]] + blend_mag)]] = False
    return alone


@dataclass(frozen=True)
class PhotometricScale:
    """Brightness of a list of detections on the catalogue's scale."""

    measured_mag: Array  # (n,) V of the detection if it is a star
    saturated: Bools  # (n,) then `measured_mag` is an upper limit of V
    limit_mag: float  # stars fainter than this are not detected
    complete_mag: float  # stars brighter than this are detected unless something hides them

    @classmethod
    def from_matches(cls, flux_e: Array, saturated: Bools, v_mag: Array, detection: Ints) -> PhotometricScale:
        """Scale from stars of magnitudes `v_mag` (k,) that lie on the detections `detection` (k,)."""
        brightness = instrumental_mag(flux_e)
        if saturated.any():
            usable = ~saturated[detection]
            if np.count_nonzero(usable) >= MIN_UNSATURATED:
                v_mag, detection = v_mag[usable], detection[usable]
        measured = brightness + upper_median(v_mag - brightness[detection])
        faintest = float(measured.max())
        return cls(measured, saturated, faintest + DEPTH_BELOW_THRESHOLD_MAG, faintest)


def brightness_agreement(v_mag: Array, measured_mag: Array, dimmed_mag: float = BRIGHTER_MAG) -> float:
    """Fraction of all pairs (star, detection) that agree in brightness, stars dimmed by at most `dimmed_mag`."""
    pairs = len(v_mag) * len(measured_mag)
    alike = _count_alike(np.ascontiguousarray(v_mag), np.sort(measured_mag), BRIGHTER_MAG, dimmed_mag)
    return float(alike / pairs) if pairs else 1.0


@dataclass(frozen=True)
class CandidatePairs:
    """All pairs of a detection and a nearby star at one attitude."""

    detection: Ints  # (k,) ascending
    star: Ints  # (k,)
    distance_px: Array  # (k,) infinite for stars outside the frame
    v_mag: Array  # (k,)
    v_sigma_mag: Array  # (k,)
    scale: PhotometricScale

    @cached_property
    def brightness_misfit(self) -> Array:
        """Difference in brightness (k,), beyond twice the catalogue's sigma: DIMMED_MAG or BRIGHTER_MAG are 1."""
        return self._compared[0]

    @cached_property
    def one_to_one_pairs(self) -> Ints:
        """Ascending indices of the pairs that are each other's nearest and agree in brightness.

        Distance and difference in brightness are added, PX_PER_MAG for a magnitude.
        """
        return self._compared[1]

    @cached_property
    def _compared(self) -> tuple[Array, Ints]:
        """Differences in brightness (k,), and indices of the one-to-one pairs."""
        k = len(self.star)
        slots = max(4, 1 << (2 * k - 1).bit_length())
        misfit, kept = np.empty(k), np.empty(k, np.int64)
        pairs = self.detection, self.star, self.distance_px, self.v_mag, self.v_sigma_mag
        count = _compare_pairs(
            *map(np.ascontiguousarray, pairs), self.scale.measured_mag, self.scale.saturated, BRIGHTER_MAG, DIMMED_MAG,
            PX_PER_MAG, np.empty(k), np.empty(slots, np.int64), misfit, kept,
        )  # fmt: skip
        return misfit, kept[:count]

    def select_unambiguous(self, which: Ints, variance_px2: Array, radius_px: float) -> Ints:
        """The one-to-one pairs `which` (m,) with an unambiguous star; `variance_px2` (m,) is per axis.

        Stars within the radius of a detection that have no detection of their own are blended with it. The detection is
        named after the brightest of them if its position allows that. It is dropped if another star is nearly as
        bright and the position does not decide between them.
        """
        sources = len(self.scale.measured_mag)
        own, faintest = np.full(sources, -1), np.full(sources, -np.inf)
        own[self.detection[which]] = self.star[which]
        faintest[self.detection[which]] = self.v_mag[which] + DISTINCT_MAG
        rival = (self.distance_px < radius_px) & (self.v_mag < faintest[self.detection])
        rival &= self.star != own[self.detection]
        if not rival.any():
            return which
        crowded = np.unique(self.detection[rival])
        named, sure, detected = which.copy(), np.ones(len(which), dtype=bool), set(self.star[which].tolist())
        rows = np.searchsorted(self.detection, [crowded, crowded + 1]).T  # the pairs of a detection are adjacent
        for i, (first, last) in zip(np.searchsorted(self.detection[which], crowded), rows, strict=True):
            group = np.arange(first, last)[self.distance_px[first:last] < radius_px]
            free = [s == self.star[which[i]] or s not in detected for s in self.star[group].tolist()]
            group = group[free]
            named[i] = group[np.argmin(self.v_mag[group])] if len(group) else which[i]
            sure[i] = self._is_decided(int(named[i]), group, float(variance_px2[i]))
            detected.add(int(self.star[named[i]]))
        return named[sure]

    def _is_decided(self, own: int, group: Ints, variance_px2: float) -> bool:
        """Whether the pair `own` explains its detection, and no nearly as bright star of the pairs `group` does."""
        squared = np.square(self.distance_px[group]) - self.distance_px[own] ** 2
        if squared.min(initial=0.0) < -2 * DECISIVE_BLEND_NATS * variance_px2 or self.brightness_misfit[own] >= 1.0:
            return False
        rivals = (self.v_mag[group] < self.v_mag[own] + DISTINCT_MAG) & (self.star[group] != self.star[own])
        return not np.any(squared[rivals] < 2 * DECISIVE_BLEND_NATS * variance_px2)

    def count_unexplained(self, snr: Array, gate_px: float) -> int:
        """Number of significant detections without a star nearer than the gate."""
        significant = snr > SIGNIFICANT_SNR
        significant[self.detection[self.distance_px < gate_px]] = False
        return int(np.count_nonzero(significant))


_compare_pairs = kernel(
    "compare_pairs", "detection: int64[n]", "star: int64[n]", "distance: float64[n]", "v_mag: float64[n]",
    "v_sigma_mag: float64[n]", "measured_mag: float64[m]", "saturated: bool[m]", "brighter_mag: float64",
    "dimmed_mag: float64", "px_per_mag: float64", "cost: out float64[n]", "of_slot: out int64[slots]",
    "misfit: out float64[n]", "kept: out int64[n]", result="int64",
)  # fmt: skip
_count_alike = kernel(
    "count_alike", "v_mag: float64[n]", "measured_mag: float64[m]", "brighter_mag: float64", "dimmed_mag: float64",
    result="int64",
)  # fmt: skip
