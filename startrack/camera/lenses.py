"""The list of lenses that camera files and calibrations know."""

from __future__ import annotations

from startrack.camera.kannala_brandt import KannalaBrandt
from startrack.camera.lens import Lens
from startrack.camera.pinhole import Pinhole

LENSES: tuple[type[Lens], ...] = (  # the first is the default
    KannalaBrandt,
    Pinhole,
)


def lens_kinds() -> dict[str, type[Lens]]:
    """The lenses by the name in camera files."""
    return {lens.model: lens for lens in LENSES}


def default_lens() -> type[Lens]:
    """The lens of a camera file without the key `model`."""
    return LENSES[0]
