"""Rover position and attitude from one picture of the stars.

    import startrack
    print(startrack.locate("image.png"))

`locate` takes a path or an array and returns a `Solution`. Stars and attitude alone, or centroids alone, are
`startrack.api.identify` and `startrack.api.detect`; `startrack.identification`, `startrack.detection` are two packages
(with `startrack.pipeline`, `startrack.localization`, ...) for those who want the stages one by one.
"""

from typing import TYPE_CHECKING, Any

from startrack.compilation import choose_cache_folder

__version__ = "0.1.0"
__all__ = ["Solution", "__version__", "locate"]

choose_cache_folder()

if TYPE_CHECKING:
    from startrack.api import Solution, locate


def __getattr__(name: str) -> Any:
    """The names of `startrack.api`, loaded when they are first asked for: importing startrack costs nothing."""
    if name not in __all__:
        raise AttributeError(f"module 'startrack' has no attribute {name!r}")
    from startrack import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return __all__
