"""The classes of hazards at the level of evidence, by their names."""

from __future__ import annotations

from _hazard_class import (
    GROSS,
    UNSEEN,
    VISIBLE,
    WITHIN,
    Class,
    defaults_drawn,
    errors_as_stated,
    near_crest,
    origin_off,
    shipped,
    silent_crater,
    stated_shape,
)  # fmt: skip
from _hazard_draws import (
    both,
    box,
    clock_of,
    clock_off,
    dip,
    ellipse,
    normal_shape,
    notch,
    posts_wrong_by,
    ridge,
    second_wall,
    shape,
    stretched,
    tilt,
    waves,
)
from _hazard_stars import dust, false_light, hidden_where, magnitudes, mast, missing, quadrant, rows_wrong

MINUTE_S, HOUR_S = 60.0, 3600.0
MIDDLE_M, OUTER_M = (0.0, 2000.0), (6000.0, 9500.0)
MAP_EVERY, SLOW_EVERY = 3, 8
THESIS, RENDERED = shipped("shackleton-thesis"), shipped("shackleton-rendered")
SHACKLETON, KEPLER = shipped("shackleton"), shipped("kepler")
CLOCKS = {"10 minutes": 10 * MINUTE_S, "an hour": HOUR_S, "6 hours": 6 * HOUR_S}
STATED = {
    "nothing wrong": Class(WITHIN, THESIS),
    "magnitudes wrong by 0.1": Class(WITHIN, THESIS, scene=magnitudes(0.1, 0.0)),
    "0.2 % of the stars missing, 0.1 % false": Class(WITHIN, THESIS, scene=missing(0.002), rays=false_light(0.001)),
    "depth and width wrong by the stated 0.2 %": Class(WITHIN, stated_shape, normal_shape),
    **{
        f"clock wrong by the stated {words}": Class(WITHIN, THESIS, clock_s=clock_of(size), time_sigma_s=size)
        for words, size in CLOCKS.items()
    },
    "silent file, errors as by default": Class(WITHIN, silent_crater, defaults_drawn(), time_sigma_s=None),
}
SILENT = {
    **{
        f"silent file, gross {fact}": Class(GROSS, silent_crater, defaults_drawn(fact), time_sigma_s=None)
        for fact in ("depth", "width", "ellipse", "rim tilt")
    },
    **{
        f"clock off by {words}, nothing stated": Class(
            GROSS if size <= HOUR_S else UNSEEN, THESIS, clock_s=clock_off(size), time_sigma_s=None
        )
        for words, size in CLOCKS.items()
    },
}
OBSTACLES = {
    **{f"box of {width} degrees, 0.3 to 5 high": Class(VISIBLE, THESIS, box(width)) for width in (5, 20, 40, 60, 80)},
    "low ridge, 30 to 100 by 0.2 to 0.6 degrees": Class(VISIBLE, THESIS, ridge((30, 100), (0.2, 0.6))),
    "low ridge, 70 to 150 by 1 to 3 degrees": Class(VISIBLE, THESIS, ridge((70, 150), (1, 3))),
    "high ridge, 30 to 90 by 5 to 20 degrees": Class(VISIBLE, THESIS, ridge((30, 90), (5, 20))),
    "notch, 5 to 60 by 0.3 to 5 degrees": Class(VISIBLE, THESIS, notch((5, 60), (0.3, 5))),
    "dip, 30 to 120 by 0.1 to 0.6 degrees": Class(VISIBLE, THESIS, dip((30, 120), (0.1, 0.6))),
    "mast to the zenith": Class(VISIBLE, THESIS, scene=hidden_where(mast)),
    "ridge and mast": Class(VISIBLE, THESIS, ridge((30, 100), (0.5, 3)), scene=hidden_where(mast)),
    "second wall, 100 to 200 degrees": Class(VISIBLE, THESIS, second_wall),
    "dust near the skyline": Class(VISIBLE, THESIS, scene=hidden_where(dust)),
    "40 to 100 degrees of azimuth dark": Class(VISIBLE, THESIS, scene=hidden_where(quadrant)),
    "3 % of the rows wrong": Class(VISIBLE, THESIS, rays=rows_wrong(0.03)),
    "box of 40 degrees, depth 0.5 % off": Class(
        VISIBLE, THESIS, both(shape("depth_1", low=0.005, high=0.005), box(40))
    ),
}
SHAPES = {
    "depth off by 0.1 to 0.5 %": Class(VISIBLE, THESIS, shape("depth_1", low=0.001, high=0.005)),
    "depth off by 1 to 2 %": Class(VISIBLE, THESIS, shape("depth_1", low=0.01, high=0.02)),
    "width off by 0.1 to 0.5 %": Class(VISIBLE, THESIS, shape("diameter_1", low=0.001, high=0.005)),
    "width off by 2 %": Class(VISIBLE, THESIS, shape("diameter_1", low=0.02, high=0.02)),
    "depth and width off by 0.2 to 1 %, in opposite ways": Class(
        VISIBLE, THESIS, shape("depth_1", "diameter_1", low=0.002, high=0.01, signs="opposite")
    ),
    "size off by 0.6 to 2 %": Class(UNSEEN, THESIS, shape("depth_1", "diameter_1", low=0.006, high=0.02, signs="same")),
    **{f"ellipse of {percent:g} %": Class(VISIBLE, THESIS, ellipse(percent / 100)) for percent in (0.5, 1, 2)},
    **{
        f"rim tilted by {size:g} degrees, {words}": Class(kind, THESIS, tilt(size), away_m=away)
        for size in (0.01, 0.05, 0.1)
        for words, kind, away in (("near the middle", UNSEEN, MIDDLE_M), ("beyond 6 km", VISIBLE, OUTER_M))
    },
    "rim with waves of 25 m": Class(VISIBLE, THESIS, waves),
    "origin 0.02 degrees off, near the middle": Class(UNSEEN, THESIS, scene=origin_off(0.02), away_m=MIDDLE_M),
    "origin 0.02 degrees off, beyond 6 km": Class(VISIBLE, THESIS, scene=origin_off(0.02), away_m=OUTER_M),
    "clock off by an hour, stated 1 s": Class(UNSEEN, THESIS, clock_s=clock_off(HOUR_S)),
}
MAPS = {
    "Shackleton, nothing wrong": Class(WITHIN, RENDERED, every=MAP_EVERY),
    "Shackleton, posts and horizon wrong as stated": Class(WITHIN, SHACKLETON, errors_as_stated, every=MAP_EVERY),
    "Kepler, posts and horizon wrong as stated": Class(WITHIN, KEPLER, errors_as_stated, every=SLOW_EVERY),
    "near crest, posts wrong as stated": Class(
        WITHIN, near_crest, errors_as_stated, away_m=(50.0, 225.0), every=MAP_EVERY
    ),
    **{
        f"Shackleton, clock wrong by the stated {words}": Class(
            WITHIN,
            SHACKLETON,
            errors_as_stated,
            clock_s=clock_of(size),
            time_sigma_s=size,
            every=MAP_EVERY if size < HOUR_S else SLOW_EVERY,
        )
        for words, size in CLOCKS.items()
    },
    **{
        f"Shackleton, clock off by {words}, nothing stated": Class(
            GROSS if size <= HOUR_S else VISIBLE,
            SHACKLETON,
            errors_as_stated,
            clock_s=clock_off(size),
            time_sigma_s=None,
            every=MAP_EVERY,
        )
        for words, size in CLOCKS.items()
    },
    "Shackleton, clock off by an hour, stated 1 s": Class(
        VISIBLE, SHACKLETON, errors_as_stated, clock_s=clock_off(HOUR_S), every=MAP_EVERY
    ),
    "Shackleton, box of 40 degrees": Class(VISIBLE, RENDERED, box(40), every=MAP_EVERY),
    "Shackleton, low ridge": Class(VISIBLE, RENDERED, ridge((30, 100), (0.2, 0.6)), every=MAP_EVERY),
    "Shackleton, mast to the zenith": Class(VISIBLE, RENDERED, scene=hidden_where(mast), every=MAP_EVERY),
    **{
        f"Shackleton, horizon stretched by {percent:g} %": Class(
            VISIBLE, RENDERED, stretched(percent / 100), every=MAP_EVERY
        )
        for percent in (0.5, 1)
    },
    "Shackleton, posts wrong by 15 m, stated 1 m": Class(VISIBLE, RENDERED, posts_wrong_by(15.0), every=MAP_EVERY),
    "Shackleton, origin 0.02 degrees off": Class(VISIBLE, RENDERED, scene=origin_off(0.02), every=MAP_EVERY),
}
CLASSES = STATED | SILENT | OBSTACLES | SHAPES | MAPS
