"""The public names of `startrack` after every submodule was imported, and documentation of their parameters."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
import types
from dataclasses import replace

import numpy as np
import pytest

import startrack
from startrack.core.types import Evidence, Exposure

IMAGE = "sample_images/near-wall.png"
PUBLIC = {
    "locate",
    "identify",
    "detect",
    "calibrate",
    "render",
    "Camera",
    "Cylinder",
    "HeightMap",
    "Terrain",
    "Evidence",
    "ExactPosterior",
    "Detections",
    "load_camera",
    "load_terrain",
    "load_catalog",
    "Solution",
}


def submodules() -> list[types.ModuleType]:
    names = [one.name for one in pkgutil.walk_packages(startrack.__path__, "startrack.")]
    return [importlib.import_module(name) for name in names if not name.endswith("__main__")]


@pytest.fixture(scope="module", autouse=True)
def import_everything() -> list[types.ModuleType]:
    """A submodule with the name of a function would now replace it."""
    return submodules()


def test_every_public_name_is_there_and_no_module():
    assert set(startrack.__all__) >= PUBLIC
    for name in startrack.__all__:
        assert not isinstance(getattr(startrack, name), types.ModuleType), name
        assert name == "__version__" or callable(getattr(startrack, name)), name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = startrack.nothing


def test_the_functions_work():
    assert startrack.detect(IMAGE).result.detections.flux_e[0] > 0
    camera, terrain = startrack.load_camera("fisheye-2048"), startrack.load_terrain("shackleton-thesis")
    assert isinstance(camera, startrack.Camera) and isinstance(terrain, startrack.Cylinder)
    assert isinstance(terrain, startrack.Terrain) and issubclass(startrack.HeightMap, startrack.Terrain)
    assert len(startrack.load_catalog()) > 100_000
    small = replace(camera, size_px=(512, 512), focal_px=(163.0, 163.0), centre_px=(255.5, 255.5))
    exposure, truth = startrack.render(
        small, terrain, time="2030-01-01T00:00:00Z", position_m=(1000.0, -500.0), heading=30.0, faint_v_mag=None
    )
    assert isinstance(exposure, Exposure) and exposure.size_px == (512, 512)
    assert truth.position_enu_m.tolist() == [1000.0, -500.0, 1.5]
    named = startrack.identify(exposure, camera=small)
    assert isinstance(named, startrack.Solution) and named, named.message


def test_a_list_of_centroids_is_identified_in_one_call():
    found = startrack.detect(IMAGE, camera="fisheye-2048").result.detections
    named = startrack.identify(found.xy_px[:200], flux=found.flux_e[:200], camera="fisheye-2048")
    assert len(named.hip) > 150 and named.false_alarm_probability < 1e-9
    again = startrack.identify(found.xy_px[:200], flux=found.flux_e[:200], size_px=(2048, 2048), fov=185.0)
    assert np.isin(again.hip, named.hip).mean() > 0.95
    with pytest.raises(ValueError, match="give a camera, or fov= with size_px="):
        startrack.identify(found.xy_px[:200])
    with pytest.raises(startrack.core.errors.NoSolution, match="0 point sources: too few"):
        startrack.identify([], camera="fisheye-2048")
    with pytest.raises(ValueError, match=r"shape \(2, 3\): give \(n, 2\)"):
        startrack.identify([[1, 2, 3], [4, 5, 6]], camera="fisheye-2048")


def test_a_calibration_prints_its_result():
    found = startrack.calibrate(["sample_images/lowell-2018-08-06.fits.bz2"], fov=180.0, name="lowell")
    assert found.camera.name == "lowell" and found.checks


def test_rays_of_ones_own_are_located_in_one_call():
    """Stars above and below the rim as a camera 3 km from the middle sees it."""
    terrain, rng = startrack.load_terrain("shackleton-thesis"), np.random.default_rng(3)
    azimuth, height = rng.uniform(0, 2 * np.pi, 1500), rng.normal(0, np.radians(1.0), 1500)
    horizon = terrain.horizon_rad(np.array([[3000.0, -1000.0]]), azimuth)
    evidence = Evidence(azimuth_rad=azimuth, elevation_rad=horizon + height, llr=np.where(height > 0, 6.0, -6.0))
    fix = startrack.ExactPosterior()(evidence, terrain)
    assert np.linalg.norm(fix.position_enu_m[:2] - [3000.0, -1000.0]) < fix.radius999_m < 60.0


def public_functions() -> dict[str, tuple[object, str]]:
    """Functions and methods that `startrack` and its packages export, by full name, each with its documentation.

    The documentation of a method is its own, its class's, and those of the method that it overrides.
    """
    found: dict[str, tuple[object, str]] = {}
    for module in [startrack, *(one for one in submodules() if hasattr(one, "__path__"))]:
        for name in getattr(module, "__all__", ()):
            one = getattr(module, name)
            home = f"{getattr(one, '__module__', '')}.{name}"
            if inspect.isfunction(one):
                found[home] = one, inspect.getdoc(one) or ""
            for key, method in vars(one).items() if inspect.isclass(one) else ():
                function = getattr(method, "__func__", method)
                is_public = key == "__call__" or not key.startswith("_")
                if inspect.isfunction(function) and is_public:
                    bases = [base for base in one.__mro__ if base.__module__.startswith("startrack")]
                    texts = [
                        text for base in bases for text in (base.__doc__, getattr(vars(base).get(key), "__doc__", ""))
                    ]
                    found[f"{home}.{key}"] = function, "\n".join(text or "" for text in texts)
    return found


def test_every_parameter_of_a_public_function_is_described():
    """By its name in the docstring, whether in a section Args or in a sentence."""
    wanting = []
    for name, (function, text) in sorted(public_functions().items()):
        parameters = [p for p in inspect.signature(function).parameters if p not in ("self", "cls")]
        missing = [p for p in parameters if not p.startswith("_") and not re.search(rf"\b{p}\b", text)]
        if missing or not text:
            wanting.append(f"{name}: {', '.join(missing) or 'no docstring'}")
    assert wanting == [], f"{len(wanting)} public functions:\n" + "\n".join(wanting)
