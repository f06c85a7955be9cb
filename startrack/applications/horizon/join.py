"""Skylines of single pictures beside that of all pictures together: what moves, and what only some pictures show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from startrack.core.types import MeasuredSkyline

# Of a bin whose skyline is another one in another picture (a dome, a crane, a branch). Of 14 pictures the highest edges
# at a rotating dome are clouds' with probabilities of 0.001 to 0.01, those of clouds elsewhere with 0.02 to 0.65.
MOVED_PROBABILITY = 0.007
MOVED_RAD = np.radians(20.0)  # by anything up to this


def join_skylines(together: MeasuredSkyline, alone: Sequence[MeasuredSkyline]) -> MeasuredSkyline:
    """The skyline of all pictures `together`, with what each picture `alone` shows and they do not show alike.

    Where the highest and the lowest edge of two pictures more probably differ because something moved than by their
    errors, and more probably than because the highest is a cloud's, the bin has the highest edge, its sigma, and the
    source "varies". A bin that only single pictures know has the value of the most accurate of them, and the scatter
    of them all adds to its sigma.

    Args:
        together: skyline (n,) of all pictures.
        alone: skylines (n,) of the pictures, one by one.
    """
    elevation, sigma, cloud, sources = (
        np.stack([getattr(one, name) for one in alone])
        for name in ("elevation_rad", "sigma_rad", "cloud_probability", "source")
    )
    bins, shown = np.arange(len(together)), np.isfinite(elevation)
    high, low = (np.argmax(np.where(shown, way * elevation, -np.inf), axis=0) for way in (1.0, -1.0))
    with np.errstate(invalid="ignore"):
        apart, both = elevation[high, bins] - elevation[low, bins], np.hypot(sigma[high, bins], sigma[low, bins])
        same = np.exp(-0.5 * np.square(apart / both)) / (both * np.sqrt(2.0 * np.pi))
        varies = (same < MOVED_PROBABILITY / MOVED_RAD) & (cloud[high, bins] < MOVED_PROBABILITY)
    chosen = np.where(varies, high, np.argmin(sigma, axis=0))
    one = shown.any(axis=0) & (varies | ~together.known)
    off = np.where(shown & ~varies, elevation - elevation[chosen, bins], 0.0)
    scatter = np.sqrt(np.square(off).sum(axis=0) / np.maximum(shown.sum(axis=0) - 1, 1))
    return MeasuredSkyline(
        azimuth_rad=together.azimuth_rad,
        elevation_rad=np.where(one, elevation[chosen, bins], together.elevation_rad),
        sigma_rad=np.where(one, np.hypot(sigma[chosen, bins], scatter), together.sigma_rad),
        source=np.select([varies, one], ["varies", sources[chosen, bins]], together.source),
        cloud_probability=np.where(one, cloud[chosen, bins], together.cloud_probability),
    )
