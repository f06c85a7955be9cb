"""The sky's light with an edge of its own: lit ground below the crest, which stars do not show, is taken for sky.

Then the stars alone tell the position, and the light has any smooth edge near the skyline. This is a hypothesis as that
of a gross error of a fact, with the same rows: the evidence decides between it and light that ends at the skyline.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.core.types import Array
from startrack.localization.free_skyline import free_log_likelihood
from startrack.localization.hypothesis import Hypothesis
from startrack.localization.neighbourhood import SectorRows
from startrack.localization.shared_errors import OWN_EDGE
from startrack.localization.skyline_model import SkylineModel

EDGE_REACH = 5.0  # of heights of the light's own edge, in its width: the cells reach no farther
EDGE_ROUGHNESS = np.array([0.01, 0.03, 0.1, 0.3])  # mean steps from sector to sector, in its width, equally likely


def with_own_edge(plain: Hypothesis, half_m: float) -> SkylineModel | None:
    """The model of a hypothesis without gross error where the light has an edge of its own; None without both.

    It serves positions within `half_m` of the same reference.
    """
    model, rows = plain.model, plain.model.seen.rows
    is_light = rows.extended_nats > 0.0
    if is_light.all() or not is_light.any():
        return None
    light = SectorRows(model.around, rows.take(np.flatnonzero(is_light)))
    nats = edge_log_likelihood(light, model.shift_of(plain.found.share @ plain.found.points))
    stars = rows.take(np.flatnonzero(~is_light))
    apart = SkylineModel.of(model.terrain, stars, model.around.reference_m, half_m, model.errors)
    by_waves = model.linear.log_volume - apart.linear.log_volume  # which the light would tell in either hypothesis
    return replace(apart, gross=OWN_EDGE, seen=replace(apart.seen, apart_nats=nats + by_waves + light.log_offset))


def edge_log_likelihood(seen: SectorRows, shift: Array) -> float:
    """Log-likelihood of rows with light, stars alike, if all have any edge as smooth as the light's own.

    It is near the skyline that stands higher than the reference's by `shift` (SECTORS,).
    """
    rows = seen.rows
    width_rad = float(np.median(rows.edge_sigma_rad[rows.extended_nats > 0.0]))
    return free_log_likelihood(seen.profiles, shift, EDGE_REACH * width_rad, EDGE_ROUGHNESS * width_rad)
