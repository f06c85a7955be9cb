"""The last fit of a lens that was found with the stars: what of it shows, and the error of all of it.

Centre, ratio of the focal lengths and decentring of a lens show in a wide field, and hardly in a narrow one, where a
shift of the centre looks like a rotation. Each of the three stays as it is of an ideal lens (in the middle, square
pixels, none) unless the stars make the contrary more probable; the covariance is that of all of them unknown.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from startrack.camera import Camera, Decentring, with_covariance
from startrack.core.types import Array
from startrack.estimation.adjust import HUBER_WITH_CUT, Prior, Scheme, Solution, State, adjust
from startrack.estimation.normal_equations import Observations
from startrack.estimation.prior_choice import solve_with_best_prior

LENGTH_SIGMAS = {"f": 0.1, "fy": 0.1, "cx": 0.06, "cy": 0.06}  # prior sigmas in focal lengths; "fy": of fy - fx
# Of the polynomial, and of decentring, which also describes refraction that differs over a narrow field.
PRIOR_SIGMAS = {"k1": 0.1, "k2": 0.1, "k3": 0.05, "k4": 0.02, "p1": 0.002, "p2": 0.002}
SCHEME = Scheme(loss=HUBER_WITH_CUT, steps=12, settled_px=3e-4, estimates_extra=True)
CHOICES = (("cx", "cy"), ("fy",), ("p1", "p2"))  # what an ideal lens does not have; "fy": beyond the ratio of 1


def fit_found_lens(
    camera: Camera, R_cam_icrs: Array, points: Observations, centre_px: tuple[float, float]
) -> tuple[Camera, Array]:
    """Camera with its marginal covariance, and attitude (3, 3), from least squares over both.

    `camera` and `R_cam_icrs` (3, 3) are roughly right for the stars `points` of one image; `centre_px` is where the
    lens's centre is expected. Raises NotIdentified where fewer than 3 stars agree.
    """
    free = ("f", "fy", "cx", "cy", *camera.lens.parameters, "p1", "p2")
    focal_px = camera.focal_px[0]
    expected = replace(camera, centre_px=centre_px, focal_px=(focal_px, focal_px), decentring=Decentring())
    whole = _fit(camera, R_cam_icrs, points, free, expected)
    prior = prior_of(whole.state.camera, expected, free)
    normal = np.asarray(np.linalg.inv(whole.equations.lens_covariance), dtype=np.float64)
    right, sigma = -normal @ prior.offset, prior.sigma.tolist()  # about the expected lens
    sets = [{name for names, shows in zip(CHOICES, shown, strict=True) if not shows for name in names}
            for shown in product((False, True), repeat=len(CHOICES))]  # fmt: skip
    roots = [np.diag([0.0 if name in fixed else s for name, s in zip(free, sigma, strict=True)]) for fixed in sets]
    fixed = sets[solve_with_best_prior(normal - np.diag(prior.precision), right, roots).prior]
    last = whole
    if fixed:
        start = whole.state.camera
        if "cx" in fixed:
            start = replace(start, centre_px=expected.centre_px)
        if "fy" in fixed:
            start = replace(start, focal_px=(start.focal_px[0], start.focal_px[0]))
        if "p1" in fixed:
            start = replace(start, decentring=expected.decentring)
        shown = tuple(name for name in free if name not in fixed)
        last = _fit(start, whole.state.R_cam_icrs[0], points, shown, expected)
    # About the lens that is stated, which may be off the mean of the unknown one.
    off = prior_of(whole.state.camera, last.state.camera, free).offset
    covariance = whole.equations.lens_covariance + np.outer(off, off)
    fitted = last.state.camera
    widest = fitted.lens.max_invertible_rad
    fitted = replace(
        fitted,
        max_angle_rad=min(camera.max_angle_rad, widest),
        calibrated_angle_rad=min(camera.calibrated_angle_rad, widest),
    )
    return with_covariance(fitted, free, covariance), last.state.R_cam_icrs[0]


def _fit(camera: Camera, R_cam_icrs: Array, points: Observations, free: tuple[str, ...], expected: Camera) -> Solution:
    """Adjustment of the `free` parameters and the attitude to `points`, with the prior of the camera `expected`."""
    start = State(camera=camera, R_cam_icrs=R_cam_icrs[None])
    return adjust(start, points, free, SCHEME, prior=prior_of(camera, expected, free))


def prior_of(camera: Camera, expected: Camera, free: tuple[str, ...]) -> Prior:
    """Prior of the free parameters: that of the camera `expected`, the adjustment starting at `camera`."""
    sigma = PRIOR_SIGMAS | {name: part * expected.focal_px[0] for name, part in LENGTH_SIGMAS.items()}
    now, then = (
        {
            "f": c.focal_px[0], "fy": c.focal_px[1] - c.focal_px[0], "cx": c.centre_px[0], "cy": c.centre_px[1],
            "p1": c.decentring.p1, "p2": c.decentring.p2, **c.lens.parameters,
        }
        for c in (camera, expected)
    )  # fmt: skip
    return Prior(np.array([sigma[n] for n in free]), np.array([then[n] - now[n] for n in free]))
