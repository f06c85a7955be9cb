"""The pixels of an image that do not count."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Mask:
    """Pixels of an image that do not count; True means masked, as in numpy's masked arrays."""

    masked: NDArray[np.bool_]  # (H, W)
    sha256: str  # of its file, or of its values; of a union the hashes of its parts, joined by "+"; "": none is given
    dead_part: float = 0.0  # of the image, that shows no light: found in the image, not given

    def __post_init__(self) -> None:
        locked = np.array(self.masked, dtype=np.bool_)
        if locked.ndim != 2:
            raise ValueError(f"Mask.masked: {locked.ndim} dimensions, expected (H, W)")
        locked.flags.writeable = False
        object.__setattr__(self, "masked", locked)
