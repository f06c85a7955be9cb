"""Rover position and attitude from one picture of the stars.

    import startrack
    print(startrack.locate("image.png"))

`locate` takes a path or an array and returns a `Solution`; `identify` and `detect` stop earlier; `locate_skyline` takes
a skyline that was measured elsewhere. `track` makes a trajectory of many images, `calibrate` a camera, `render` an
image, `predict` the expected accuracy, `measure_horizon` the skyline of a fixed camera. The packages
(`startrack.detection`, `startrack.identification`, `startrack.localization`, ...) have the stages one by one. Every
name is loaded at its first use: importing startrack costs nothing.
"""

import importlib
from typing import TYPE_CHECKING, Any

from startrack.core import __version__

_MODULES = {  # public name to the module that has it
    "detect": "api.solve", "identify": "api.solve", "locate": "api.solve", "locate_skyline": "api.solve",
    "track": "api.solve",
    "calibrate": "api.applications", "measure_horizon": "api.applications",
    "predict": "api.applications", "render": "api.applications",
    "Solution": "api.solution",
    "Camera": "camera", "load_camera": "camera",
    "Cylinder": "terrain", "HeightMap": "terrain", "Terrain": "terrain", "load_terrain": "terrain",
    "load_catalog": "catalog",
    "Detections": "core.types", "Evidence": "core.types", "Fix": "core.types",
    "ExactPosterior": "localization",
    "BadInput": "core.errors", "NoSolution": "core.errors",
}  # fmt: skip
__all__ = [
    "BadInput", "Camera", "Cylinder", "Detections", "Evidence", "ExactPosterior", "Fix", "HeightMap", "NoSolution",
    "Solution", "Terrain", "__version__", "calibrate", "detect", "identify", "load_camera", "load_catalog",
    "load_terrain", "locate", "locate_skyline", "measure_horizon", "predict", "render", "track",
]  # fmt: skip

if TYPE_CHECKING:
    from startrack.api.applications import calibrate, measure_horizon, predict, render
    from startrack.api.solution import Solution
    from startrack.api.solve import detect, identify, locate, locate_skyline, track
    from startrack.camera import Camera, load_camera
    from startrack.catalog import load_catalog
    from startrack.core.errors import BadInput, NoSolution
    from startrack.core.types import Detections, Evidence, Fix
    from startrack.localization import ExactPosterior
    from startrack.terrain import Cylinder, HeightMap, Terrain, load_terrain


def __getattr__(name: str) -> Any:
    """Public name of startrack, from its module at the first use."""
    if name not in _MODULES:
        raise AttributeError(f"module 'startrack' has no attribute {name!r}")
    return getattr(importlib.import_module(f"startrack.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
