"""What a dark frame and a flat field changed in the counts of an image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from startrack.core.mask import Mask


@dataclass(frozen=True, kw_only=True, eq=False)
class Correction:
    """The correction of an exposure by a dark frame, a flat field, or both."""

    recorded_adu: NDArray[np.float32]  # (H, W) counts as the sensor recorded them: they show saturation and clipping
    mask: Mask | None  # pixels that cannot be corrected; None: all can
    sensitivity_1: NDArray[np.float32] | None  # (H, W) of the flat field, 1 at its median; None: no flat field
    scales_black: bool  # the black level was divided too, because without a dark frame it is not known
    dark_sha256: str | None  # of the file; None: no dark frame
    flat_sha256: str | None
