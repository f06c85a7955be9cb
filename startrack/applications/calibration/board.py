"""Calibration from pictures of a chessboard or a ChArUco board."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from startrack import __version__
from startrack.applications.calibration.acceptance import RINGS, STARS_PER_RING, Check, Checked, calibrated_rays
from startrack.applications.calibration.board_pose import Board, Corners, find_corners, initial_board_state
from startrack.applications.calibration.lens_fit import LensFit, fit_state
from startrack.applications.calibration.run import RefusedImage
from startrack.camera import Camera, camera_to_dict
from startrack.core.types import Array, BadInput, Exposure, NotIdentified
from startrack.estimation.normal_equations import observations

MIN_PICTURES = 3
MIN_CORNERS = 100
LARGEST_HELD_OUT_RMS_PX = 1.0
LARGEST_MAP_SIGMA_PX = 0.5
FORMAT = "startrack.calibration/1"


@dataclass(frozen=True, kw_only=True)
class BoardCalibration(Checked):
    """A lens calibrated with boards, and its acceptance checks."""

    camera: Camera
    fit: LensFit
    checks: tuple[Check, ...]
    images: tuple[str, ...]
    refused: tuple[RefusedImage, ...]


def calibrate_board(
    exposures: Sequence[Exposure],
    board: Board,
    *,
    name: str = "camera",
    progress: Callable[[str], None] = lambda text: None,
) -> BoardCalibration:
    """The camera of pictures of one flat board. Raises BadInput (size_mismatch), NotIdentified (no_stars: no board)."""
    found: list[Corners] = []
    images: list[str] = []
    refused: list[RefusedImage] = []
    for exposure in exposures:
        if exposure.size_px != exposures[0].size_px:
            raise BadInput("size_mismatch", f"{exposure.name} has another size than {exposures[0].name}")
        progress(f"searching the board in {exposure.name}")
        seen = find_corners(exposure, board)
        if seen is None:
            refused.append(RefusedImage(name=exposure.name, reason="no_stars", message="the board was not found"))
        else:
            found.append(seen)
            images.append(exposure.name)
    if not found:
        raise NotIdentified("the board was found in no picture: are --pattern and --charuco right?", reason="no_stars")
    progress("fitting the lens")
    return _calibrate_corners(found, exposures[0].size_px, name, images, refused)


def _calibrate_corners(
    found: list[Corners], size_px: tuple[int, int], name: str, images: list[str], refused: list[RefusedImage]
) -> BoardCalibration:
    points = observations([c.xy_px for c in found], [c.position for c in found])
    fit = fit_state(initial_board_state(points, size_px), points)
    width, height = size_px
    ends = np.array([[-0.5, -0.5], [width - 0.5, -0.5], [-0.5, height - 0.5], [width - 0.5, height - 0.5]])
    edge = min(float(np.max(fit.camera.angle_rad(ends))), fit.camera.lens.max_invertible_rad)
    camera = replace(fit.camera, name=name, max_angle_rad=max(edge, fit.camera.calibrated_angle_rad))
    return BoardCalibration(
        camera=camera,
        fit=fit,
        checks=_check_acceptance(fit, points.xy_px, len(found)),
        images=tuple(images),
        refused=tuple(refused),
    )


def _check_acceptance(fit: LensFit, xy_px: Array, pictures: int) -> tuple[Check, ...]:
    """All checks, the most informative first."""
    camera = fit.camera
    angle = camera.angle_rad(xy_px[fit.used])
    ring = np.clip((RINGS * angle / camera.calibrated_angle_rad).astype(int), 0, RINGS - 1)
    rings = int(np.sum(np.bincount(ring, minlength=RINGS) >= STARS_PER_RING))
    sigma = float(np.max(camera.projection_sigma_px(calibrated_rays(camera))))
    used, held = int(fit.used.sum()), fit.held_out_rms_px
    tilt = "more pictures: the board tilted by 30 degrees and more, near and far, and in every corner of the image"
    return (
        Check("pictures with a board", pictures, f">= {MIN_PICTURES}", pictures >= MIN_PICTURES,
             "insufficient_geometry", tilt),
        Check("corners", used, f">= {MIN_CORNERS}", used >= MIN_CORNERS, "insufficient_geometry", tilt),
        Check("held-out RMS [px]", held, f"<= {LARGEST_HELD_OUT_RMS_PX}", held <= LARGEST_HELD_OUT_RMS_PX,
             "inconsistent_evidence", "a flat board and sharp pictures are needed"),
        Check("rings with corners", rings, f"= {RINGS}", rings == RINGS, "insufficient_geometry", tilt),
        Check("map sigma [px]", sigma, f"<= {LARGEST_MAP_SIGMA_PX}", sigma <= LARGEST_MAP_SIGMA_PX,
             "insufficient_geometry", tilt),
    )  # fmt: skip


def board_dict(found: BoardCalibration) -> dict[str, Any]:
    """The calibration's JSON object."""
    fit, failed = found.fit, found.failed_checks
    return {
        "format": FORMAT,
        "status": "refused" if failed else "ok",
        "reason": failed[0].reason if failed else None,
        "message": "; ".join(f"{c.name} is {c.value:.3g}, required {c.limit}: {c.advice}" for c in failed),
        "camera": None if failed else camera_to_dict(found.camera),
        "lens": {
            "corners": int(fit.used.sum()),
            "clipped": int((~fit.used).sum()),
            "rms_px": fit.rms_px,
            "held_out_rms_px": fit.held_out_rms_px,
            "models": [vars(candidate) for candidate in fit.candidates],
        },
        "gates": [
            {"name": c.name, "value": float(c.value), "limit": c.limit, "passed": bool(c.passed)} for c in found.checks
        ],
        "images": [{"image": image} for image in found.images],
        "refused": [vars(refused) for refused in found.refused],
        "provenance": {"version": __version__},
    }


def board_line(found: BoardCalibration, name: str) -> str:
    """Summary in one line."""
    fit, camera = found.fit, found.camera
    verdict = "ok" if found.accepted else f"refused {found.failed_checks[0].reason}"
    return (
        f"{name}  {verdict}  {len(found.images)} of {len(found.images) + len(found.refused)} pictures  "
        f"{int(fit.used.sum())} corners  held-out {fit.held_out_rms_px:.2f} px  f {camera.focal_px[0]:.2f} px/rad  "
        f"calibrated to {np.degrees(camera.calibrated_angle_rad):.1f}°"
    )
