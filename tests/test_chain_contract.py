"""The contract of the chain: two passes over an image, types of what the stages hand to each other, direct calls."""

from __future__ import annotations

import ast
import builtins
import inspect
import textwrap
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, is_dataclass, replace
from datetime import UTC, datetime
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import pytest

from startrack.catalog import load_catalog
from startrack.chain import Located, Outcome, Refused, Settings, pipeline, two_looks
from startrack.core.types import Evidence, Explored, Fix, MeasuredSkyline, NotLocated
from startrack.evidence import StarPhotometer
from startrack.localization import ExactPosterior, PseudoGradient
from startrack.rendering import Series
from startrack.rendering.compose import light_e, read_out

STAGE_VALUES = (Located, Refused, Evidence, Fix, Explored, MeasuredSkyline)


def named_types(hint: Any) -> Iterator[Any]:
    """The types of which `hint` is made; an array is one."""
    yield hint
    if get_origin(hint) is not np.ndarray:
        for part in get_args(hint):
            yield from named_types(part)


def values_within(kind: type, known: set[type]) -> set[type]:
    """The classes of this project whose objects the fields of a dataclass or named tuple hold."""
    if kind not in known and (is_dataclass(kind) or hasattr(kind, "_fields")):
        known.add(kind)
        for hint in get_type_hints(kind).values():
            for part in named_types(hint):
                if isinstance(part, type) and part.__module__.startswith(("startrack.chain", "startrack.core")):
                    values_within(part, known)
    return known


def test_no_value_of_a_stage_has_a_field_without_a_type() -> None:
    values = set[type]()
    for kind in STAGE_VALUES:
        values_within(kind, values)
    assert len(values) > 20
    untyped = [
        f"{kind.__name__}.{name}"
        for kind in values
        for name, hint in get_type_hints(kind).items()
        if Any in named_types(hint)
    ]
    assert untyped == []


@pytest.mark.parametrize(
    "function",
    [pipeline.locate, pipeline.locate_measured, pipeline.identify, pipeline.identify_blind, pipeline.detect],
)
def test_a_static_reader_finds_every_call_of_the_way_of_an_image(function: Any) -> None:
    """Each is a call of an imported or local name, or of a method of a value; none is handed on to be called later."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    known = vars(pipeline)
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    assert len(calls) > 4
    for call in calls:
        handed = [*call.args, *(word.value for word in call.keywords)]
        assert not any(isinstance(one, ast.Lambda) for one in handed)
        assert not any(callable(known.get(one.id)) for one in handed if isinstance(one, ast.Name))
        if isinstance(call.func, ast.Name):
            local = call.func.id in inspect.signature(function).parameters
            assert local or callable(known.get(call.func.id) or getattr(builtins, call.func.id, None)), call.func.id
        else:
            assert isinstance(call.func, ast.Attribute) and not call.func.attr.startswith("__")


def test_the_way_of_an_image_is_short() -> None:
    for function in (pipeline.locate, pipeline.locate_measured):
        assert len(inspect.getsource(function).splitlines()) < 40


@dataclass(frozen=True)
class CountedPhotometry(StarPhotometer):
    """The photometry of stars, counted."""

    calls: Counter[str] = field(default_factory=Counter)

    def __call__(self, *args: Any, **words: Any) -> Any:
        self.calls["stars"] += 1
        return super().__call__(*args, **words)


@dataclass(frozen=True)
class CountedPosterior(ExactPosterior):
    """The posterior, counted."""

    calls: Counter[str] = field(default_factory=Counter)
    changes: dict[str, Any] = field(default_factory=dict)  # of each fix
    moved_m: float = 0.0  # of the second one

    def __call__(self, evidence: Any, terrain: Any) -> Any:
        self.calls["located"] += 1
        fix = replace(super().__call__(evidence, terrain), **self.changes)
        return replace(fix, compared_at_m=fix.compared_at_m + self.moved_m) if self.calls["located"] == 2 else fix


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often the sky is measured, and what `locate_counted` adds."""
    counter, measure = Counter[str](), two_looks.pixels_near_skyline

    def measure_counted(*args: Any) -> Any:
        counter["sky"] += 1
        return measure(*args)

    monkeypatch.setattr(two_looks, "pixels_near_skyline", measure_counted)
    return counter


def scene_at(located: Any, sky_mag: float | None, place_m: tuple[float, float]) -> Any:
    """A scene of the crater, with the camera of the `located` frame."""
    catalog, known = load_catalog().brighter_than(7.0), located.result
    series = Series(
        camera=known.camera, terrain=known.terrain, catalog=catalog, seed=3, time_utc=datetime(2031, 2, 3, tzinfo=UTC),
        east_m=place_m[0], north_m=place_m[1], exposure_s=3.0, faint_v_mag=None, sky_v_mag_arcsec2=sky_mag,
    )  # fmt: skip
    return series.scene(0)[0]


def locate_counted(
    located: Any, calls: Counter[str], electrons: Any = None, changes: Any = None, **settings: Any
) -> Outcome:
    """The frame, or one of other `electrons` (H, W), located; `changes` are those of its fixes."""
    known, exposure = located.result, located.result.exposure
    if electrons is not None:
        pixels = read_out(electrons, known.camera.sensor, rng=np.random.default_rng(1))
        exposure = replace(exposure, pixels_adu=pixels, time_utc=datetime(2031, 2, 3, tzinfo=UTC))
    counted = {
        "photometer": CountedPhotometry(calls),
        "localizer": CountedPosterior(calls=calls, changes=changes or {}),
    }
    catalog = load_catalog().brighter_than(7.0)
    return pipeline.locate(exposure, known.camera, known.terrain, catalog, Settings(**counted | settings))


@pytest.mark.parametrize(
    ("sky_mag", "place_m", "stars"),
    [(21.0, (1200.0, 800.0), 2), (22.0, (9700.0, 300.0), 2), (None, (1200.0, 800.0), 1)],
    ids=["bright sky", "below the wall", "black sky"],
)
def test_an_image_is_measured_and_located_twice(
    located: Any, calls: Counter[str], sky_mag: float | None, place_m: tuple[float, float], stars: int
) -> None:
    found = locate_counted(located, calls, light_e(scene_at(located, sky_mag, place_m)))
    assert isinstance(found, Located) and found.status == "ok", found.message
    assert found.evidence_source == ("stars" if sky_mag is None else "both")
    assert calls == {"stars": stars, "sky": 1, "located": 2}


@pytest.mark.parametrize("source", ["stars", "sky", "both"])
def test_so_it_is_with_each_source_of_evidence(located: Any, calls: Counter[str], source: str) -> None:
    electrons = light_e(scene_at(located, 21.0, (-4500.0, 3000.0)))
    found = locate_counted(located, calls, electrons, evidence_sources=source)
    assert isinstance(found, Located) and found.evidence_source == source
    assert calls == {"stars": 2, "sky": 1, "located": 2}


def test_so_is_an_image_of_two_exposures(located: Any, calls: Counter[str]) -> None:
    scene = scene_at(located, 21.0, (3000.0, -2500.0))
    moved = replace(scene, position_enu_m=scene.position_enu_m + np.array([400.0, 0.0, 0.0]))
    found = locate_counted(located, calls, 0.7 * light_e(scene) + 0.3 * light_e(moved))
    assert isinstance(found, Refused) and "two skylines" in found.message
    assert calls == {"stars": 2, "sky": 1, "located": 1}


def test_a_second_fix_far_from_what_was_measured_is_refused(located: Any, calls: Counter[str]) -> None:
    electrons = light_e(scene_at(located, 21.0, (-4500.0, 3000.0)))
    found = locate_counted(located, calls, electrons, localizer=CountedPosterior(calls=calls, moved_m=1500.0))
    assert isinstance(found, Refused) and found.reason == "inconsistent_evidence"
    assert "the light of the sky moves the skyline by" in found.message
    assert calls == {"stars": 2, "sky": 1, "located": 2}


def test_where_there_is_no_skyline_to_measure_at_the_second_fix_is_by_the_same_stars(
    located: Any, calls: Counter[str]
) -> None:
    found = locate_counted(located, calls, changes={"ambiguous": True})
    assert isinstance(found, Located) and found.status == "ambiguous"
    assert found.sky_unused == "several positions fit the stars" and found.sky_brightness_mag_arcsec2 is None
    assert calls == {"stars": 1, "located": 2}
    calls.clear()
    clipped = np.clip(located.result.exposure.pixels_adu - 100.0, 0.0, None)
    exposure = replace(located.result.exposure, pixels_adu=clipped)
    clip = replace(located, result=replace(located.result, exposure=exposure))
    damaged = locate_counted(clip, calls)
    assert isinstance(damaged, Located) and damaged.damage is not None
    assert calls["located"] == 2 and calls["stars"] <= 2 and calls["sky"] <= 1


def test_a_method_without_a_posterior_is_asked_once(located: Any, calls: Counter[str]) -> None:
    asked = []

    def descend(evidence: Any, terrain: Any) -> Any:
        asked.append(evidence)
        return PseudoGradient()(evidence, terrain)

    found = locate_counted(located, calls, localizer=descend)
    assert isinstance(found, Located) and found.fix.search == "approximate"
    assert len(asked) == 1 and calls == {"stars": 1}


def test_a_refusal_of_the_first_look_ends_the_passes(located: Any, calls: Counter[str]) -> None:
    def refuse(evidence: Any, terrain: Any) -> Any:
        raise NotLocated("no", reason="outside_search_area")

    found = locate_counted(located, calls, localizer=refuse)
    assert isinstance(found, Refused) and found.reason == "outside_search_area"
    assert calls == {"stars": 1}
