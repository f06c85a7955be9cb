"""Any smooth skyline near the map's: what a wrong map, time or camera file shows, and light with an edge of its own.

Lit ground below the crest, which stars do not show, is taken for sky: over some directions the light then has any
smooth edge near the skyline, and the stars alone show the skyline. This is a hypothesis as that of a gross error of a
fact, with the same rows, errors and chain of obstacles, in which a state "the light has its own edge" stands for the
notches. The evidence decides between it and light that ends at the skyline.
"""

from __future__ import annotations

from dataclasses import replace
from math import log

import numpy as np

from startrack.core.statistics import shares
from startrack.core.types import SECTORS, Array
from startrack.kernels.library import kernel
from startrack.localization.hypothesis import Hypothesis
from startrack.localization.likelihood.neighbourhood import OwnEdge, SectorRows
from startrack.localization.likelihood.obstacle_chain import clear_emissions
from startrack.localization.likelihood.shared_errors import OWN_EDGE
from startrack.localization.likelihood.skyline_model import SkylineModel
from startrack.localization.likelihood.skyline_profiles import LOW_RAD

FREE_HEIGHTS, SPREAD = 121, 6.5  # of heights about the map's skyline, closer about it
ROUGHNESS_RAD = np.radians([0.003, 0.01, 0.03, 0.1])  # mean steps from sector to sector, equally likely
JUMP = 1e-4  # probability of a step to anywhere
HEIGHTS = np.sinh(SPREAD * np.linspace(-1, 1, FREE_HEIGHTS)) / np.sinh(SPREAD)  # in the farthest one
EDGE_REACH = 5.0  # of heights of the light's own edge, in its width: the cells reach no farther
EDGE_ROUGHNESS = np.array([0.01, 0.03, 0.1, 0.3])  # mean steps from sector to sector, in its width, equally likely


def free_log_likelihood(seen: SectorRows, shift: Array, lift_rad: Array | None = None) -> float:
    """Log-likelihood of the rows if the skyline is the map's, higher by `shift` (SECTORS,), and any smooth curve.

    `lift_rad` (SECTORS,) is that of the light beyond what is expected; None: 0.
    """
    heights = -LOW_RAD * HEIGHTS
    shifts = shift + heights[:, None]
    gains = seen.gains(shifts, None if lift_rad is None else np.tile(lift_rad, (len(heights), 1)))
    logs = list_free_logs(clear_emissions(seen.profiles, shifts, gains), heights, ROUGHNESS_RAD).sum(axis=1)
    return float(np.logaddexp.reduce(logs)) - log(len(logs))


def list_free_logs(likelihoods: Array, heights: Array, roughness_rad: Array) -> Array:
    """Log-likelihoods (n, SECTORS) of each sector by the sectors before it, for each roughness (n,) of the curve.

    The skyline is a curve at any of the `heights` (k,) of each sector, which have the `likelihoods` (k, SECTORS).
    """
    by_sector, cells = np.ascontiguousarray(likelihoods.T), np.gradient(heights)
    return np.array([_pass(by_sector, heights, cells, rough) for rough in roughness_rad])


def _pass(likelihood: Array, heights: Array, cells: Array, rough: float) -> Array:
    """Log-likelihoods (SECTORS,) by one pass around the circle, with steps of a mean size `rough` to either side."""
    found = np.empty(len(likelihood))
    _pass_curve(likelihood, heights, cells, rough, JUMP, np.empty((5, len(heights))), found)
    return found


_pass_curve = kernel(
    "pass_curve", "likelihood: float64[sectors, n >= 1]", "heights: float64[n]", "cells: float64[n]", "rough: float64",
    "jump: float64", "scratch: out float64[5, n]", "found: out float64[sectors]",
)  # fmt: skip


def with_own_edge(plain: Hypothesis, half_m: float) -> SkylineModel | None:
    """Model of a hypothesis without gross error where the light has an edge of its own; None without stars or light.

    It serves positions within `half_m` of the same reference.
    """
    seen, errors = plain.model.seen, plain.model.errors
    stars, light = seen.stars, seen.light
    if not len(stars.rows) or not len(light.rows):
        return None
    around = replace(plain.model.around, half_m=half_m)
    width_rad = float(np.median(light.rows.edge_sigma_rad))
    shift, lift_rad = plain.model.shift_of(plain.sampled.share @ plain.sampled.points)
    heights = EDGE_REACH * width_rad * HEIGHTS
    at_heights = clear_emissions(light.profiles, shift + heights[:, None])
    logs = list_free_logs(at_heights, heights, EDGE_ROUGHNESS * width_rad)
    whole, likely = logs.sum(axis=1), shares(logs.sum(axis=1)) @ logs
    likely += (np.logaddexp.reduce(whole) - np.log(len(whole)) - likely.sum()) / SECTORS  # all equally likely before
    likely += light.profiles.offset + stars.profiles.offset - seen.profiles.offset  # the same about one reference
    most = np.maximum(likely, 0.0)  # where light and stars are far apart it exceeds all numbers
    edge = OwnEdge(seen, np.exp(likely - most), np.ones(SECTORS), most)
    by_stars = SkylineModel(replace(seen, around=around, edge=edge), errors, around.error_slopes_rad(errors), OWN_EDGE)
    return replace(by_stars, seen=replace(by_stars.seen, edge=edge._replace(lit=_find_lit(by_stars, shift, lift_rad))))


def _find_lit(by_stars: SkylineModel, shift: Array, lift_rad: Array | None) -> Array:
    """Probabilities (SECTORS,) of light with its own edge at the likelier skyline: the `shift`, or that of the stars.

    The light is lifted by `lift_rad` (SECTORS,) above the `shift`; None: by nothing. All light has its own edge in the
    linear model of `by_stars`.
    """
    shifts = np.stack([shift, by_stars.shift_of(by_stars.solve_linear().parameters)[0]])
    lifts = None if lift_rad is None else np.stack([lift_rad, np.zeros(SECTORS)])
    likelier = int(np.argmax(by_stars.log_likelihood_of(shifts, lifts)))
    return by_stars.lit(by_stars.states_at(shifts[likelier], None if lifts is None else lifts[likelier]))
