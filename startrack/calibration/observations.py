"""What a calibration rests on: stars of one or more images, each with its pixel and its direction."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from startrack.types import Array, Ints, Value, array


@dataclass(frozen=True, kw_only=True)
class Observations(Value):
    """Matched points of one camera, sorted by image. Directions may be stars or any other known directions."""

    image: Ints = array("n", dtype=np.int64)  # 0 ... images - 1, ascending
    xy_px: Array = array("n", 2)  # measured
    covariance_px2: Array = array("n", 2, 2)  # of the measurement
    rays_icrs: Array = array("n", 3)  # apparent directions, refraction included where there is air

    def __post_init__(self) -> None:
        super().__post_init__()
        if np.any(np.diff(self.image) < 0) or np.any(self.image[:1] < 0):
            raise ValueError("Observations.image must ascend from 0")

    def __len__(self) -> int:
        return len(self.image)

    @property
    def images(self) -> int:
        """Number of images."""
        return int(self.image[-1]) + 1 if len(self.image) else 0

    def take(self, which: Any) -> Observations:
        """The observations selected by a mask or by ascending indices; image numbers stay as they are."""
        return replace(
            self,
            image=self.image[which],
            xy_px=self.xy_px[which],
            covariance_px2=self.covariance_px2[which],
            rays_icrs=self.rays_icrs[which],
        )


def observations(
    xy_px: list[Array], rays_icrs: list[Array], covariance_px2: list[Array] | float | None = None
) -> Observations:
    """Observations of pixels and directions given image by image.

    `covariance_px2`: per image (n, 2, 2), or one variance per axis [px^2] for all. None: the centroid errors are not
    known; a fit then takes them from the scatter.
    """
    counts = [len(xy) for xy in xy_px]
    covariance = (
        np.concatenate(covariance_px2)
        if isinstance(covariance_px2, list)
        else np.broadcast_to((covariance_px2 or 0.0) * np.eye(2), (sum(counts), 2, 2))
    )
    return Observations(
        image=np.repeat(np.arange(len(counts)), counts),
        xy_px=np.concatenate(xy_px),
        covariance_px2=covariance,
        rays_icrs=np.concatenate(rays_icrs),
    )
