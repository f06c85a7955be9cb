"""What every answer promises: refused means no position, wrappers change nothing, larger errors are not more welcome.

Monotone: with the noise and the place kept and one error growing, an answer never follows two refused sizes, and none
is beyond twice its 99.9 % circle. One image is the same to `locate` and to `track`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hazard_helpers import (
    Ground,
    box,
    catalog_to,
    crater_with,
    error_in_circles,
    rays_of,
    rendered,
    ridge,
    small_camera,
    stretched,
    terrain_named,
)
from localization_helpers import Delegating

import startrack
from startrack.api.solution import Solution
from startrack.applications.tracking.files import track_record
from startrack.chain import Refused, Settings, locate_rays, pipeline
from startrack.core.types import Array, Evidence, Fix, NoSolution
from startrack.localization import ExactPosterior
from startrack.output import result_dict
from startrack.terrain import Cylinder, ForwardingTerrain, Terrain

THESIS, RENDERED, SHACKLETON = "shackleton-thesis", "shackleton-rendered", "shackleton"
PLACES = ((6000.0, -2500.0), (-1500.0, 700.0), (-4000.0, 7200.0))
OUTER_PLACES = ((6000.0, -2500.0), (-6100.0, 4800.0), (-4000.0, 7200.0))
FLOOR_PLACES = ((1280.0, -140.0), (-2400.0, 1900.0))
STEPS, MAP_STEPS, TOLERANCE = 10, 7, 1e-9
OWN_WORDS = ("timing_ms", "provenance")  # of a record: the localizer has another name
POSE = ("east_m", "north_m", "up_m", "radius95_m", "latitude_deg", "longitude_deg")
CASES = {"located": (None, 0.0), "blocked": (box(40, 3), 0.0), "refused": (None, 0.5)}  # ground; depth of the file off


def deeper(part: float) -> Terrain:
    """The thesis's crater by a file whose depth is wrong by a part."""
    crater = terrain_named(THESIS)
    assert isinstance(crater, Cylinder)
    return replace(crater, depth_m=crater.depth_m * (1.0 + part))


def solve(terrain: Terrain, ground: Ground | None = None, sky_v_mag: float = 22.0, **settings: Any) -> Any:
    """The outcome of a rendered image."""
    image = rendered(ground, sky_v_mag)
    return pipeline.locate(image, small_camera(), terrain, catalog_to(7.0), Settings(**settings))


def plain_localizer(evidence: Evidence, terrain: Terrain) -> Fix:
    """The posterior as a function of a user's own."""
    return ExactPosterior()(evidence, terrain)


def require_no_position(outcome: Any) -> None:
    assert isinstance(outcome, Refused)
    record, solution = result_dict(outcome), Solution(outcome)
    assert record["position"] is None and record["modes"] == []
    values = (solution.position, solution.position_m, solution.covariance_m2, solution.radius95_m, solution.modes)
    assert values == (None,) * 5


# The reason differs by how far the image came: before the stars, at them, at the first fix, after the second one.
@pytest.mark.parametrize(
    "case", ["no_time", "no_stars", "another_crater", pytest.param("not_identified", marks=pytest.mark.slow)]
)
def test_an_image_refused_before_its_second_fix_has_no_position(case: str) -> None:
    image, crater = rendered(), deeper(0.1 if case == "another_crater" else 0.0)
    noise = np.random.default_rng(1).normal(100.0, 3.0, image.pixels_adu.shape).astype(np.float32)
    changes: dict[str, dict[str, Any]] = {
        "no_time": {"time_utc": None}, "no_stars": {"pixels_adu": noise},
        "not_identified": {"pixels_adu": np.ascontiguousarray(image.pixels_adu[:, ::-1])},
    }  # fmt: skip
    changed = replace(image, **changes.get(case, {}))
    require_no_position(pipeline.locate(changed, small_camera(), crater, catalog_to(7.0)))


@pytest.mark.slow
@pytest.mark.parametrize(("part", "sky_v_mag"), [(0.03, 22.0), (0.1, 19.5), (0.5, 19.5)])
def test_an_image_refused_after_its_second_fix_has_no_position(part: float, sky_v_mag: float) -> None:
    require_no_position(solve(deeper(part), sky_v_mag=sky_v_mag))


def require_same(one: Any, other: Any, where: str = "") -> None:
    """Two JSON values agree, numbers to TOLERANCE."""
    if isinstance(one, dict) and isinstance(other, dict):
        assert one.keys() == other.keys(), where
        for key in one:
            require_same(one[key], other[key], f"{where}.{key}")
    elif isinstance(one, list) and isinstance(other, list):
        assert len(one) == len(other), where
        for k, pair in enumerate(zip(one, other, strict=True)):
            require_same(*pair, f"{where}[{k}]")
    elif isinstance(one, float) and isinstance(other, float):
        assert other == pytest.approx(one, rel=TOLERANCE, abs=TOLERANCE), where
    else:
        assert one == other, where


@pytest.mark.slow
@pytest.mark.parametrize("case", list(CASES))
def test_an_image_is_solved_alike_through_wrappers(case: str) -> None:
    ground, part = CASES[case]
    known, terrain = solve(deeper(part), ground), deeper(part)
    assert (known.status == "refused") == (case == "refused")
    others = [
        solve(ForwardingTerrain(terrain), ground), solve(Delegating(terrain), ground),  # type: ignore[arg-type]
        solve(terrain, ground, localizer=plain_localizer),
    ]  # fmt: skip
    for other in others:
        one, two = ({k: v for k, v in result_dict(x).items() if k not in OWN_WORDS} for x in (known, other))
        require_same(one, two)
        assert (other.reason, other.warnings) == (known.reason, known.warnings)


def answer(rays: Any, localizer: Any = None) -> dict[str, Any]:
    """What a fix by stars states; or the reason of a refusal."""
    try:
        found = locate_rays(rays, localizer)
    except NoSolution as refusal:
        return {"reason": str(refusal.reason)}
    fix, level = found.fix, None if found.fix.integrity is None else float(found.fix.integrity.protection_level_m)
    place: list[Array] = [fix.position_enu_m, fix.covariance_m2.ravel()]
    return {
        "position": np.concatenate(place).tolist(), "circles": [fix.radius95_m, fix.radius999_m], "level": level,
        "ambiguous": fix.ambiguous, "weights": [mode.weight for mode in fix.modes],
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("case", list(CASES))
def test_rays_are_located_alike_through_wrappers(case: str) -> None:
    ground, part = CASES[case]
    grown = crater_with({"depth_1": -part / (1.0 + part)})
    rays, _ = rays_of(THESIS, PLACES[0], 3, ground or grown)
    known = answer(rays)
    assert ("reason" in known) == (case == "refused")
    for wrapper in (ForwardingTerrain, Delegating):
        require_same(known, answer(replace(rays, terrain=wrapper(rays.terrain))))
    require_same(known, answer(rays, plain_localizer))


def sizes(low: float, high: float, steps: int = STEPS) -> list[float]:
    return np.geomspace(low, high, steps).tolist()


GROWING: dict[str, tuple[str, tuple[tuple[float, float], ...], list[float], Callable[[float], dict[str, Any]]]] = {
    "depth": (THESIS, PLACES, sizes(5e-4, 0.05), lambda x: {"ground": crater_with({"depth_1": x})}),
    "shallower": (THESIS, PLACES, sizes(5e-4, 0.05), lambda x: {"ground": crater_with({"depth_1": -x})}),
    "width": (THESIS, PLACES, sizes(5e-4, 0.05), lambda x: {"ground": crater_with({"diameter_1": x})}),
    "ellipse": (THESIS, PLACES, sizes(5e-4, 0.05), lambda x: {"ground": crater_with({"ellipse_cos_1": x})}),
    "rim tilt": (
        THESIS, OUTER_PLACES, sizes(1e-4, 0.02), lambda x: {"ground": crater_with({"rim_tilt_east_rad": x})},
    ),
    "ridge": (THESIS, PLACES, sizes(0.05, 12.0), lambda x: {"ground": ridge(70, x)}),
    "stretch": (RENDERED, FLOOR_PLACES, sizes(1e-3, 0.1, MAP_STEPS), lambda x: {"ground": stretched(x)}),
    "clock": (SHACKLETON, FLOOR_PLACES, sizes(120.0, 43_200.0, MAP_STEPS), lambda x: {"offset_s": x}),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "number"), [(kind, k) for kind in GROWING for k in range(len(GROWING[kind][1]))])
def test_a_growing_error_is_right_then_wider_then_refused(kind: str, number: int) -> None:
    name, places, grown, change = GROWING[kind]
    found = [error_in_circles(*rays_of(name, places[number], 11 + number, **change(size))) for size in grown]
    told = [f"{size:.3g}: {'refused' if x is None else f'{x:.2f} circles off'}" for size, x in zip(grown, found)]  # noqa: B905
    assert not [x for x in found if x is not None and x > 2.0], told
    twice = [k for k in range(1, len(found)) if found[k - 1] is None and found[k] is None]
    assert not twice or all(x is None for x in found[twice[0] :]), told


@pytest.mark.slow
@pytest.mark.parametrize("case", ["located", "blocked"])
def test_a_track_of_one_image_states_what_its_fix_states(case: str) -> None:
    ground, _ = CASES[case]
    image, crater = rendered(ground, faintest_v_mag=np.inf), terrain_named(THESIS)  # the catalogue is the whole one
    solution = startrack.locate(image, camera=small_camera(), terrain=crater)
    assert solution.status == "ok", solution.message
    alone = solution.to_dict()["position"]
    (frame,) = track_record(startrack.track([image], camera=small_camera(), terrain=crater))["frames"]
    assert frame["status"] == "used"
    require_same({key: alone[key] for key in POSE}, {key: frame[key] for key in POSE})
    for prefix in ("", "filtered_"):
        ee, en, nn = (frame[f"{prefix}covariance_{text}_m2"] for text in ("ee", "en", "nn"))
        require_same(alone["covariance_m2"], [[ee, en], [en, nn]])
        assert frame[f"{prefix}radius95_m"] == pytest.approx(alone["radius95_m"], rel=TOLERANCE)
