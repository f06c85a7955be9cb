"""A fitted camera as its file holds it: the file's parameter names, and the origin of a decentred lens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.camera import Camera, Decentring
from startrack.camera.uncertainty import cap_grid, lens_jacobian
from startrack.types import Array

LOCKED_1 = 1e-6  # relative: fx and fy of square pixels, apart just enough that the matrix has an inverse


def written(camera: Camera, free: tuple[str, ...], covariance: Array) -> Camera:
    """The camera with the covariance (m, m) of its free parameters, all in the file's names."""
    names, wide = _fx_and_fy(camera, free, covariance)
    if camera.decentring:
        camera, wide = _centred_for_the_rest(camera, names, wide)
    return replace(camera, covariance_order=names, covariance=0.5 * (wide + wide.T))


def _fx_and_fy(camera: Camera, free: tuple[str, ...], covariance: Array) -> tuple[tuple[str, ...], Array]:
    """Covariance with fx and fy each by itself (square pixels: all but locked together)."""
    if free[0] == "fx":
        return free, covariance
    names = ("fx", "fy", *free[1:])
    spread = np.zeros((len(names), len(free)))
    spread[0, 0], spread[1, 0] = 1.0, camera.focal_px[1] / camera.focal_px[0]
    spread[np.arange(2, len(names)), np.arange(1, len(free))] = 1.0
    wide = spread @ covariance @ spread.T
    # Exactly locked, the matrix could not be inverted by those who want to weigh errors with it.
    wide[[0, 1], [0, 1]] += 0.5 * (LOCKED_1 * camera.focal_px[0]) ** 2
    return names, wide


def _centred_for_the_rest(camera: Camera, names: tuple[str, ...], covariance: Array) -> tuple[Camera, Array]:
    """The same map, written with the origin e of decentring at which the centre is that of the lens without it.

    What a decentred lens does looks much like a tilt and a shift of the centre; with e the shift is part of it.
    """
    grid = cap_grid(camera.calibrated_angle_rad)
    bare = replace(camera, decentring=Decentring())
    flat = [lens_jacobian(bare, grid, ("cx",)).reshape(-1, 1), bare.jacobian_px_per_rad(grid).reshape(-1, 3)]
    bent = lens_jacobian(bare, grid, ("p2",)).reshape(-1)
    shift_px = float(np.linalg.lstsq(np.concatenate(flat, axis=1), bent, rcond=None)[0][0])
    fx, fy = (-camera.focal_px[0] if camera.mirrored else camera.focal_px[0]), camera.focal_px[1]
    e = abs(shift_px / fx)
    more = e - camera.decentring.e
    bend = camera.decentring
    centre = (camera.centre_px[0] + fx * bend.p2 * more, camera.centre_px[1] + fy * bend.p1 * more)
    turn = np.eye(len(names))
    turn[names.index("cx"), names.index("p2")] = fx * more
    turn[names.index("cy"), names.index("p1")] = fy * more
    moved = replace(camera, centre_px=centre, decentring=Decentring(bend.p1, bend.p2, e))
    return moved, turn @ covariance @ turn.T
