"""Names of the sources of an image: stars with names, planets, Sun, Moon and Earth, and sources without a name."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array, Body, Bools, Detections, Identification, Ints, Rows, array


@dataclass(frozen=True, kw_only=True)
class NamedStars(Rows):
    """Sources with the names of stars; one-to-one."""

    star: Ints = array("n", dtype=np.int64)  # index into Stars
    xy_px: Array = array("n", 2)  # as measured
    saturated: Bools = array("n", dtype=np.bool_)


@dataclass(frozen=True, kw_only=True, eq=False)
class SourceNames:
    """Names of the sources of an image."""

    stars: NamedStars
    bodies: tuple[Body, ...]  # planets, Sun, Moon, Earth; without a site those that have a source
    is_nameless: Bools  # (n,) which detections are neither a star nor a body
    unexplained: int  # significant detections that neither a catalogue star nor a body explains


def identified_names(sources: Detections, known: Identification, bodies: tuple[Body, ...]) -> SourceNames:
    """Names that the identification `known` gives to `sources`; `bodies` are those over the site."""
    is_nameless = np.ones(len(sources), dtype=bool)
    is_nameless[known.detection] = False
    return SourceNames(
        stars=NamedStars(
            star=known.star, xy_px=sources.xy_px[known.detection], saturated=sources.saturated[known.detection]
        ),
        bodies=bodies, is_nameless=is_nameless, unexplained=known.unexplained,
    )  # fmt: skip
