"""How far apart the posts stood that a height map was made from: it may have been interpolated to finer ones."""

from __future__ import annotations

import numpy as np

from startrack.types import Array

STRETCH = 64  # posts of one spectrum
LONGEST = 4  # cycles a stretch: below, what is left of the trend counts
STEEPEST = -6.5  # d ln power / d ln frequency; rough ground -2.6 to -4, measured maps of the Moon to -5.6
DROP = 3.0  # of that slope at the edge of what an interpolated map carries
ROWS = 512  # that are looked at, evenly spread
QUIET = 0.25  # bends of a surface that is straight between posts, beside those at the posts
FURTHEST = 8  # posts
FEWEST_STRETCHES = 30


def carried_spacing(heights_m: Array) -> float:
    """Spacing [posts] of the ground that a map (rows, columns) carries; 1 where it is as fine as its posts.

    What was drawn smoothly through posts further apart has next to no waves shorter than two of those; what was drawn
    straight between them bends there only. NaN are holes.
    """
    return max(_by_spectrum(heights_m), float(_by_bends(heights_m)))


def _by_spectrum(h: Array) -> float:
    """From the longest waves at which the power falls, over half an octave, faster than that of any ground."""
    power = _power(h)
    if power is None:
        return 1.0
    wave = np.arange(LONGEST, len(power))
    longer = np.rint(wave / np.sqrt(2)).astype(int)
    slope = np.log(power[wave] / power[longer]) / np.log(wave / longer)
    usual = max(np.log(power[2 * LONGEST] / power[LONGEST]) / np.log(2), STEEPEST + 1)
    steep = np.flatnonzero(slope < min(STEEPEST, usual - DROP))
    if not len(steep):
        steep = np.flatnonzero(slope < STEEPEST)
    if not len(steep):
        return 1.0
    edge = np.sqrt(wave[steep[0]] * longer[steep[0]])
    return float((len(power) - 1) / edge)


def _power(h: Array) -> Array | None:
    """Mean power (STRETCH / 2 + 1) of stretches of rows and of columns without holes, trends taken off."""
    found = []
    for lines in (h, h.T):
        if lines.shape[1] < STRETCH:
            continue
        lines = lines[:: max(len(lines) // ROWS, 1)]
        stretches = np.lib.stride_tricks.sliding_window_view(lines, STRETCH, axis=1)[:, :: STRETCH // 2]
        found.append(stretches.reshape(-1, STRETCH))
    known = [part[np.isfinite(part).all(axis=1)] for part in found]
    if sum(map(len, known)) < FEWEST_STRETCHES:
        return None
    z = np.concatenate(known)
    along = np.arange(STRETCH) - (STRETCH - 1) / 2
    z = z - z.mean(axis=1, keepdims=True)
    z -= (z @ along / (along @ along))[:, None] * along
    power = np.mean(np.abs(np.fft.rfft(z * np.hanning(STRETCH), axis=1)) ** 2, axis=0)
    return np.asarray(np.maximum(power, 1e-12 * max(float(power.max()), 1e-30)))


def _by_bends(h: Array) -> int:
    """The widest spacing at which all bends lie at one post, or at two neighbours, of each so many."""
    return max((s for s in range(2, FURTHEST + 1) for lines in (h, h.T) if _bends_at_posts(lines, s)), default=1)


def _bends_at_posts(lines: Array, spacing: int) -> bool:
    """Whether the bends down the first axis are `spacing` apart."""
    bends = np.diff(lines, 2, axis=0) ** 2
    if len(bends) < 4 * spacing:
        return False
    parts = [part[np.isfinite(part)] for part in (bends[k::spacing] for k in range(spacing))]
    if not all(part.size for part in parts):
        return False
    size = np.sqrt([part.mean() for part in parts])
    quiet = size < QUIET * size.max()
    longest = run = 0
    for one in np.tile(quiet, 2):
        run = run + 1 if one else 0
        longest = max(longest, run)
    return longest >= max(spacing - 2, 1)
