"""One-to-one matches of detections with the stars beside them, by place and brightness; blends named with care."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from startrack.identification.match import DEPTH_BELOW_THRESHOLD_MAG, MAGNITUDE_TOLERANCE, SIGNIFICANT_SNR
from startrack.types import Array, Bools, Ints

DIMMED_MAG = 1.6  # by haze, branches and the lens's rim; nothing makes a star brighter
PX_PER_MAG = 0.6  # farther off or less alike
PLAINLY_FAINTER_MAG = 0.3  # a light that two stars share goes by the name of the one plainly brighter
OVERWHELMING_LOG_ODDS = 12.0  # for one star's place against another's


def middle(values: Array) -> float:
    """The upper median: numpy's own costs a tenth of the whole identification."""
    return float(np.sort(values)[len(values) // 2])


def last_of_each(numbers: Ints) -> Bools:
    """Whether a value stands for the last time at each of the places in `numbers` (n,), all at least 0."""
    place = np.arange(len(numbers))
    last = np.empty(numbers.max(initial=-1) + 1, dtype=np.int64)
    last[numbers] = place  # of several, the last one stays
    standing: Bools = last[numbers] == place
    return standing


@dataclass(frozen=True)
class Light:
    """What a list of detections says of brightness, on the catalogue's scale."""

    measured_mag: Array  # (n,) V if the detection is a star
    saturated: Bools  # (n,) then at least as bright as that
    limit_mag: float  # faintest V that might have been detected
    certain_mag: float  # stars brighter than that must have been, if nothing hides them

    @classmethod
    def of(cls, flux_e: Array, saturated: Bools, v_mag: Array, detection: Ints) -> Light:
        """From stars of these magnitudes (k,) that lie on these detections (k,)."""
        brightness = -2.5 * np.log10(np.maximum(flux_e, 1e-9))
        plain = ~saturated[detection]  # a saturated star's flux is a lower bound
        if np.count_nonzero(plain) >= 3:
            v_mag, detection = v_mag[plain], detection[plain]
        measured = brightness + middle(v_mag - brightness[detection])
        faintest = float(measured.max())
        return cls(measured, saturated, faintest + DEPTH_BELOW_THRESHOLD_MAG, faintest)


@dataclass(frozen=True)
class Pairs:
    """Detections and the stars beside them, at one attitude."""

    detection: Ints  # (k,) ascending
    star: Ints  # (k,)
    distance_px: Array  # (k,) infinite for stars outside the frame
    v_mag: Array  # (k,)
    v_sigma_mag: Array  # (k,)
    light: Light

    @cached_property
    def dimmed_mag(self) -> Array:
        """By how much the detection (k,) is fainter than the star, beyond the star's own uncertainty."""
        dimmed = self.light.measured_mag[self.detection] - self.v_mag
        dimmed[self.light.saturated[self.detection] & (dimmed > 0)] = 0.0
        beyond: Array = np.copysign(np.maximum(np.abs(dimmed) - 2 * self.v_sigma_mag, 0.0), dimmed)
        return beyond

    @cached_property
    def strain(self) -> Array:
        """How far star and detection (k,) are from equally bright, as a part of what is allowed."""
        return np.maximum(self.dimmed_mag / DIMMED_MAG, self.dimmed_mag / -MAGNITUDE_TOLERANCE)

    @cached_property
    def agrees(self) -> Bools:
        """Whether star and detection (k,) may be equally bright."""
        return self.strain < 1.0

    @cached_property
    def nearest(self) -> Ints:
        """Which pairs are each other's nearest and agree in brightness: at most one per detection and per star.

        Of those nearly as near, the one that is as bright comes first.
        """
        seen = np.argsort(-self.distance_px - PX_PER_MAG * np.abs(self.dimmed_mag))
        seen = seen[np.isfinite(self.distance_px[seen])]
        seen = seen[last_of_each(self.star[seen])]
        seen = seen[self.agrees[seen]]
        return np.sort(seen[last_of_each(self.detection[seen])])

    def plain(self, which: Ints, variance_px2: Array, radius_px: float) -> Ints:
        """Of the one-to-one pairs `which` (m,), with variances per axis (m,), those whose star is beyond doubt.

        Stars within the radius of a detection that are not detected beside it share its light. It is named after the
        brightest of them, if the place allows; not at all if another is nearly as bright, and the place does not tell
        them apart.
        """
        sources = len(self.light.measured_mag)
        own, faintest = np.full(sources, -1), np.full(sources, -np.inf)
        own[self.detection[which]] = self.star[which]
        faintest[self.detection[which]] = self.v_mag[which] + PLAINLY_FAINTER_MAG
        rival = (self.distance_px < radius_px) & (self.v_mag < faintest[self.detection])
        rival &= self.star != own[self.detection]
        crowds = np.unique(self.detection[rival])
        if not len(crowds):
            return which
        named, sure, detected = which.copy(), np.ones(len(which), dtype=bool), set(self.star[which].tolist())
        rows = np.searchsorted(self.detection, [crowds, crowds + 1]).T  # the pairs of a detection stand together
        for i, (first, last) in zip(np.searchsorted(self.detection[which], crowds), rows, strict=True):
            group = np.arange(first, last)[self.distance_px[first:last] < radius_px]
            free = [s == self.star[which[i]] or s not in detected for s in self.star[group].tolist()]
            group = group[free]
            named[i] = group[np.argmin(self.v_mag[group])] if len(group) else which[i]
            sure[i] = self._told_apart(int(named[i]), group, float(variance_px2[i]))
            detected.add(int(self.star[named[i]]))
        return named[sure]

    def _told_apart(self, own: int, group: Ints, variance_px2: float) -> bool:
        """Whether the pair `own` explains its detection, and the fainter stars of the pairs `group` do not."""
        squared = np.square(self.distance_px[group]) - self.distance_px[own] ** 2
        if squared.min(initial=0.0) < -2 * OVERWHELMING_LOG_ODDS * variance_px2 or not self.agrees[own]:
            return False
        rivals = (self.v_mag[group] < self.v_mag[own] + PLAINLY_FAINTER_MAG) & (self.star[group] != self.star[own])
        return not np.any(squared[rivals] < 2 * OVERWHELMING_LOG_ODDS * variance_px2)

    def unexplained(self, snr: Array, gate_px: float) -> int:
        """Significant detections with no star near that could be a part of their light."""
        significant = snr > SIGNIFICANT_SNR
        significant[self.detection[self.distance_px < gate_px]] = False
        return int(np.count_nonzero(significant))
