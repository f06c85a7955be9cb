"""Error of a height map: published for its product, or between its posts, estimated from the map itself, made coarser.

Also the spacing of the posts that an interpolated map was made from.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array, BadInput
from startrack.terrain.maps.raster import Raster

MIN_ERROR_M = 0.1
MIN_RATIO_ROUGH = 0.5  # natural ground is no smoother: errors fall with the distance of the posts, not with its square
MIN_RATIO_SMOOTH = MIN_RATIO_ROUGH**2  # a curve without any roughness: errors fall with the square
MIN_POSTS = 9  # a side
SPACING_TOLERANCE_OCTAVES = 0.25  # error of `carried_spacing`
SPECTRUM_POSTS = 64  # posts of one spectrum
MIN_CYCLES = 4  # per stretch; longer waves contain the rest of the trend
STEEPEST_SPECTRUM = -6.5  # d ln power / d ln frequency; rough ground -2.6 to -4, measured maps of the Moon to -5.6
MIN_DROP = 3.0  # of that slope where the power of an interpolated map ends
MAX_ROWS = 512  # evenly spread rows and columns whose spectra are averaged
MAX_STRAIGHT_BEND = 0.25  # between the true posts, relative to the largest bends
MAX_SPACING = 8  # posts; wider spacings of straight lines are not sought
MIN_STRETCHES = 30  # for a mean spectrum


@dataclass(frozen=True)
class MapProduct:
    """A published map product: what its files are called, and the standard deviation of its heights."""

    name: str
    pattern: str  # of the file's name, without regard to case
    height_sigma_m: float
    source: str


PRODUCTS = (
    MapProduct(
        "Copernicus GLO-30", r"copernicus_dsm_(cog_)?10|glo.?30|cop30", 2.4,
        "4 m (90 %), on steep ground relative too: Copernicus DEM Product Handbook",
    ),
    MapProduct(
        "SRTM", r"^[ns]\d\d[ew]\d\d\d.*\.hgt$|srtm", 5.3,
        "relative error 8.7 m (90 %) in Eurasia, 7.0 m in North America: Farr et al. 2007",
    ),
    MapProduct("USGS 3DEP, lidar", r"usgs_1m_|usgs_one_meter", 0.15, "10 cm on bare ground, 15 cm under plants: QL2"),
    MapProduct("USGS 3DEP, 1/3 arcsec", r"usgs_13_|ned.?13", 1.55, "RMSE against geodetic marks: Gesch et al. 2014"),
)  # fmt: skip


def find_product(file_name: str) -> MapProduct | None:
    """The product that a file of this name belongs to; None for others."""
    return next((one for one in PRODUCTS if re.search(one.pattern, file_name.lower())), None)


def error_between_posts_m(height_map: Raster, spacing: float | None = None) -> float:
    """RMS error [m] of the ground midway between posts, where it is bilinear in the map and is not in truth.

    Every other post left out gives the error of a grid twice as coarse, three of four left out that of one four times
    as coarse; their ratio extrapolates to the grid itself. Of a map that was interpolated from posts further apart,
    `spacing` posts of the map (None: `carried_spacing`), the error is that of those posts. Raises BadInput bad_terrain
    if there are no heights.
    """
    h = height_map.heights_m.astype(np.float64)
    if not np.isfinite(h).any():
        raise BadInput("bad_terrain", f"{height_map.source or 'the map'}: no post has a height here: give another map")
    if min(h.shape) < MIN_POSTS:
        steps = np.concatenate([np.ravel(np.diff(h, axis=axis)) for axis in (0, 1)])
        return max(_rms(steps), MIN_ERROR_M)
    apart = carried_spacing(h) if spacing is None else spacing
    if apart > 1:
        return max(_error_of_posts_further_apart(h, apart), MIN_ERROR_M)
    twice, four_times = _left_out_rms(h), _left_out_rms(h[::2, ::2])
    falls = float(np.clip(twice / max(four_times, 1e-9), MIN_RATIO_ROUGH, 1.0))
    return max(twice * falls, MIN_ERROR_M)


def _error_of_posts_further_apart(h: Array, apart: float) -> float:
    """RMS error [m] of a surface drawn smoothly through posts `apart` times as far from each other as the map's.

    The finest levels contain only that surface; the error is measured at the first coarser one.
    """
    level = max(int(np.ceil(np.log2(apart) - SPACING_TOLERANCE_OCTAVES)), 0)
    step = 2**level
    # Which of the map's posts are the true ones is not known; between them the surface is too smooth.
    shifted = [h[k::step, k::step] for k in range(step)]
    twice, four_times = max(
        (_left_out_rms(part, cubic=True), _left_out_rms(part[::2, ::2], cubic=True)) for part in shifted
    )
    falls = float(np.clip(twice / max(four_times, 1e-9), MIN_RATIO_SMOOTH, 1.0))
    return float(twice * falls ** np.log2(2 * step / apart))


def _left_out_rms(h: Array, cubic: bool = False) -> float:
    """RMS [m] of the posts midway in rows, in columns and in cells of every other post (r, c), against these.

    Midway bilinear, or with `cubic` on the cubic through four posts.
    """
    h = h[: len(h) - 1 + len(h) % 2, : h.shape[1] - 1 + h.shape[1] % 2]

    def midway(a: Array) -> Array:
        return np.asarray((9 * (a[1:-2] + a[2:-1]) - a[:-3] - a[3:]) / 16 if cubic else 0.5 * (a[1:] + a[:-1]))

    kept = h[::2, ::2]
    down, across = midway(kept), midway(kept.T).T
    middle = midway(across)
    inner = slice(3, -3, 2) if cubic else slice(1, None, 2)
    off = [h[::2, inner] - across, h[inner, ::2] - down, h[inner, inner] - middle]
    return _rms(np.concatenate([np.ravel(o) for o in off]))


def _rms(values: Array) -> float:
    """RMS of the finite values; 0 if there are none."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else 0.0


def carried_spacing(heights_m: Array) -> float:
    """Spacing [posts] of the ground that a map (rows, columns) carries; 1 where it is as fine as its posts.

    A smooth surface through posts further apart has little power at wavelengths below two of their spacings; one
    with straight lines between them bends only there. NaN are holes.
    """
    directions = heights_m, heights_m.T
    bends = (s for s in range(2, MAX_SPACING + 1) for lines in directions if _bends_at_posts(lines, s))
    return max(_spacing_by_spectrum(heights_m), float(max(bends, default=1)))


def _spacing_by_spectrum(h: Array) -> float:
    """Spacing [posts] by the longest waves whose power falls, over half an octave, faster than that of any ground."""
    power = _power(h)
    if power is None:
        return 1.0
    wave = np.arange(MIN_CYCLES, len(power))
    longer = np.rint(wave / np.sqrt(2)).astype(int)
    slope = np.log(power[wave] / power[longer]) / np.log(wave / longer)
    usual = max(np.log(power[2 * MIN_CYCLES] / power[MIN_CYCLES]) / np.log(2), STEEPEST_SPECTRUM + 1)
    steep = np.flatnonzero(slope < min(STEEPEST_SPECTRUM, usual - MIN_DROP))
    if not len(steep):
        steep = np.flatnonzero(slope < STEEPEST_SPECTRUM)
    if not len(steep):
        return 1.0
    edge = np.sqrt(wave[steep[0]] * longer[steep[0]])
    return float((len(power) - 1) / edge)


def _power(h: Array) -> Array | None:
    """Mean power (SPECTRUM_POSTS / 2 + 1) of stretches of rows and of columns without holes, trends taken off."""
    found = []
    for lines in (h, h.T):
        if lines.shape[1] < SPECTRUM_POSTS:
            continue
        lines = lines[:: max(len(lines) // MAX_ROWS, 1)]
        stretches = np.lib.stride_tricks.sliding_window_view(lines, SPECTRUM_POSTS, axis=1)[:, :: SPECTRUM_POSTS // 2]
        found.append(stretches.reshape(-1, SPECTRUM_POSTS))
    known = [part[np.isfinite(part).all(axis=1)] for part in found]
    if sum(map(len, known)) < MIN_STRETCHES:
        return None
    z = np.concatenate(known)
    along = np.arange(SPECTRUM_POSTS) - (SPECTRUM_POSTS - 1) / 2
    z = z - z.mean(axis=1, keepdims=True)
    z -= (z @ along / (along @ along))[:, None] * along
    power = np.mean(np.abs(np.fft.rfft(z * np.hanning(SPECTRUM_POSTS), axis=1)) ** 2, axis=0)
    return np.asarray(np.maximum(power, 1e-12 * max(float(power.max()), 1e-30)))


def _bends_at_posts(lines: Array, spacing: int) -> bool:
    """Whether all bends down the first axis lie at one post, or at two neighbours, in each period of `spacing`."""
    bends = np.diff(lines, 2, axis=0) ** 2
    if len(bends) < 4 * spacing:
        return False
    parts = [part[np.isfinite(part)] for part in (bends[k::spacing] for k in range(spacing))]
    if not all(part.size for part in parts):
        return False
    size = np.sqrt([part.mean() for part in parts])
    quiet = size < MAX_STRAIGHT_BEND * size.max()
    longest = run = 0
    for one in np.tile(quiet, 2):
        run = run + 1 if one else 0
        longest = max(longest, run)
    return longest >= max(spacing - 2, 1)
