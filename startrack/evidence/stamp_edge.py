"""An edge of the background in a star's stamp: ground darker or brighter than the sky, before a skyline is known.

The fit itself is in kernels/photometry.c.
"""

from __future__ import annotations

from math import ceil, sqrt

import numpy as np

from startrack.core.types import Array

FLAT_SLOPE_EXCESS = 3.0  # squared slopes that the noise explains, in its variance: 5 % of flat stamps have more
EDGE_FARTHEST_PX, EDGE_STEP_PX = 6.0, 0.5  # of its place from the star, for a PSF of 1 px; beyond, it has no part
EDGE_PLACES = int(2 * EDGE_FARTHEST_PX / EDGE_STEP_PX) + 1
WIDTH_PART = 0.3  # sigma of how much wider or sharper the edge is: in a real photograph stars had 0.58 px, a wall 0.95
EDGE_PHASES = 64  # of a pixel between two places of the edge, in the table of its light: right to 2e-6 of a contrast
CONTRAST_SIGMAS = 10.0  # of an edge, in the noise of a pixel: a normal prior about none


def edge_profiles(radius: int, width_px: float) -> Array:
    """Light of an edge of `width_px`, and its slope [1/px], (2, EDGE_PHASES + 1, n) single, for stamps of that radius.

    Rows are phases of a pixel between two places of the edge; the column is the number of places from the edge to the
    pixel, from the farthest before it to the farthest behind it.
    """
    from scipy.special import ndtr

    spread_px, step_px = sqrt(width_px * width_px + 1.0 / 12.0), width_px * EDGE_STEP_PX  # pixels have a side of 1
    farthest = ceil(radius * sqrt(2.0) / step_px) + 1 + EDGE_PLACES // 2
    places = np.arange(-farthest, farthest + 1.0) + np.linspace(0.0, 1.0, EDGE_PHASES + 1)[:, None]
    z = places * step_px / spread_px
    slope = np.exp(-0.5 * z * z) / (np.sqrt(2.0 * np.pi) * spread_px)
    return np.stack([ndtr(z), slope]).astype(np.float32)
