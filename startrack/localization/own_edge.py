"""The sky's light with an edge of its own: lit ground below the crest, which stars do not show, is taken for sky.

Over some directions the light then has any smooth edge near the skyline, and the stars alone show the skyline. This is
a hypothesis as that of a gross error of a fact, with the same rows, errors and chain of obstacles, in which a state
"the light has its own edge" stands for the notches. The evidence decides between it and light that ends at the skyline.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.core.statistics import shares
from startrack.core.types import SECTORS
from startrack.localization.free_skyline import list_free_logs
from startrack.localization.hypothesis import Hypothesis
from startrack.localization.neighbourhood import OwnEdge, SectorRows
from startrack.localization.shared_errors import OWN_EDGE
from startrack.localization.skyline_model import SkylineModel

EDGE_REACH = 5.0  # of heights of the light's own edge, in its width: the cells reach no farther
EDGE_ROUGHNESS = np.array([0.01, 0.03, 0.1, 0.3])  # mean steps from sector to sector, in its width, equally likely


def with_own_edge(plain: Hypothesis, half_m: float) -> SkylineModel | None:
    """The model of a hypothesis without gross error where the light has an edge of its own; None without both.

    It serves positions within `half_m` of the same reference.
    """
    seen, errors = plain.model.seen, plain.model.errors
    rows = seen.rows
    is_light = rows.extended_nats > 0.0
    if is_light.all() or not is_light.any():
        return None
    around = replace(plain.model.around, half_m=half_m)
    stars, light = (SectorRows(around, rows.take(np.flatnonzero(own))) for own in (~is_light, is_light))
    width_rad = float(np.median(rows.edge_sigma_rad[is_light]))
    shift = plain.model.shift_of(plain.found.share @ plain.found.points)
    logs = list_free_logs(light.profiles, shift, EDGE_REACH * width_rad, EDGE_ROUGHNESS * width_rad)
    whole, likely = logs.sum(axis=1), shares(logs.sum(axis=1)) @ logs
    likely += (np.logaddexp.reduce(whole) - np.log(len(whole)) - likely.sum()) / SECTORS  # all equally likely before
    offset = light.profiles.offset + stars.profiles.offset - seen.profiles.offset  # the same about one reference
    edge = OwnEdge(stars.profiles, np.exp(likely + offset))
    return SkylineModel(replace(seen, around=around, edge=edge), errors, around.error_slopes_rad(errors), OWN_EDGE)
