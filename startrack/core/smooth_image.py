"""Smooth images, such as background and noise of an exposure, of which few rows tell all."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]


@dataclass(frozen=True)
class SmoothImage:
    """An image (H, W) that is linear between the middles of blocks of `side` rows; above and below them constant."""

    rows: Image  # (n, W): the values in the middle of each block
    side: int
    height: int

    @classmethod
    def of(cls, image: Image) -> SmoothImage:
        """Any image (H, W): each of its rows is kept."""
        return cls(image, 1, len(image))

    @classmethod
    def from_blocks(cls, values: NDArray[Any], side: int, shape: tuple[int, ...]) -> SmoothImage:
        """Linear interpolation, in x too, between the middles of square blocks (n, m) that cover an image (H, W)."""
        import cv2

        size = values.shape[1] * side, values.shape[0]
        wide: Any = cv2.resize(values, size, interpolation=cv2.INTER_LINEAR)
        return cls(np.ascontiguousarray(wide[:, : shape[1]]), side, shape[0])

    def whole(self) -> Image:
        """The image itself (H, W)."""
        import cv2

        size = self.rows.shape[1], len(self.rows) * self.side
        full: Any = cv2.resize(self.rows, size, interpolation=cv2.INTER_LINEAR)
        return full[: self.height]

    def at(self, row: Any, column: Any) -> Image:
        """Values at whole pixels; the indices are broadcast."""
        above = np.clip((row + 0.5) / self.side - 0.5, 0.0, len(self.rows) - 1)
        low = above.astype(np.int64)
        part = (above - low).astype(np.float32)
        high = np.minimum(low + 1, len(self.rows) - 1)
        return np.asarray(self.rows[low, column] * (1 - part) + self.rows[high, column] * part)
