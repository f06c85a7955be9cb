"""A camera from pictures of a chessboard or a ChArUco board."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from startrack import __version__
from startrack.calibration.acceptance import RINGS, STARS_PER_RING, Gate, Gated, seen_rays
from startrack.calibration.board_corners import Board, Corners, corners
from startrack.calibration.board_pose import first_board_state
from startrack.calibration.fit import LensFit, fit_state
from startrack.calibration.observations import observations
from startrack.calibration.run import Refused
from startrack.camera import Camera, camera_to_dict
from startrack.types import BadInput, Exposure, NotIdentified

FEWEST_PICTURES = 3
FEWEST_CORNERS = 100
HELD_OUT_RMS_PX = 1.0
MAP_SIGMA_PX = 0.5
FORMAT = "startrack.calibration/1"


@dataclass(frozen=True, kw_only=True)
class BoardCalibration(Gated):
    """The lens that boards give, and what was asked of it."""

    camera: Camera
    fit: LensFit
    gates: tuple[Gate, ...]
    images: tuple[str, ...]
    refused: tuple[Refused, ...]


def calibrate_board(
    exposures: Sequence[Exposure],
    board: Board,
    *,
    name: str = "camera",
    progress: Callable[[str], None] = lambda text: None,
) -> BoardCalibration:
    """The camera of pictures of one flat board. Raises BadInput size_mismatch, NotIdentified (no_stars: no board)."""
    found: list[Corners] = []
    images: list[str] = []
    refused: list[Refused] = []
    for exposure in exposures:
        if exposure.size_px != exposures[0].size_px:
            raise BadInput("size_mismatch", f"{exposure.name} has another size than {exposures[0].name}")
        progress(f"looking for the board in {exposure.name}")
        seen = corners(exposure, board)
        if seen is None:
            refused.append(Refused(name=exposure.name, reason="no_stars", message="the board was not found"))
        else:
            found.append(seen)
            images.append(exposure.name)
    if not found:
        raise NotIdentified("the board was found in no picture: are --pattern and --charuco right?", reason="no_stars")
    progress("fitting the lens")
    return _fitted(found, exposures[0].size_px, name, images, refused)


def _fitted(
    found: list[Corners], size_px: tuple[int, int], name: str, images: list[str], refused: list[Refused]
) -> BoardCalibration:
    points = observations([c.xy_px for c in found], [c.place for c in found])
    fit = fit_state(first_board_state(points, size_px), points)
    width, height = size_px
    ends = np.array([[-0.5, -0.5], [width - 0.5, -0.5], [-0.5, height - 0.5], [width - 0.5, height - 0.5]])
    edge = min(float(np.max(fit.camera.angle_rad(ends))), fit.camera.lens.max_invertible_rad)
    camera = replace(fit.camera, name=name, max_angle_rad=max(edge, fit.camera.calibrated_angle_rad))
    return BoardCalibration(
        camera=camera,
        fit=fit,
        gates=_gates(fit, points.xy_px, len(found)),
        images=tuple(images),
        refused=tuple(refused),
    )


def _gates(fit: LensFit, xy_px: Any, pictures: int) -> tuple[Gate, ...]:
    camera = fit.camera
    angle = camera.angle_rad(xy_px[fit.used])
    ring = np.clip((RINGS * angle / camera.calibrated_angle_rad).astype(int), 0, RINGS - 1)
    rings = int(np.sum(np.bincount(ring, minlength=RINGS) >= STARS_PER_RING))
    sigma = float(np.max(camera.projection_sigma_px(seen_rays(camera))))
    used, held = int(fit.used.sum()), fit.held_out_rms_px
    tilt = "more pictures: the board tilted by 30 degrees and more, near and far, and in every corner of the image"
    return (
        Gate("pictures with a board", pictures, f">= {FEWEST_PICTURES}", pictures >= FEWEST_PICTURES,
             "insufficient_geometry", tilt),
        Gate("corners", used, f">= {FEWEST_CORNERS}", used >= FEWEST_CORNERS, "insufficient_geometry", tilt),
        Gate("held-out RMS [px]", held, f"<= {HELD_OUT_RMS_PX}", held <= HELD_OUT_RMS_PX, "inconsistent_evidence",
             "a flat board and sharp pictures are needed"),
        Gate("rings with corners", rings, f"= {RINGS}", rings == RINGS, "insufficient_geometry", tilt),
        Gate("map sigma [px]", sigma, f"<= {MAP_SIGMA_PX}", sigma <= MAP_SIGMA_PX, "insufficient_geometry", tilt),
    )  # fmt: skip


def board_dict(found: BoardCalibration) -> dict[str, Any]:
    """The JSON object."""
    fit, failed = found.fit, found.failed
    return {
        "format": FORMAT,
        "status": "refused" if failed else "ok",
        "reason": failed[0].reason if failed else None,
        "message": "; ".join(f"{g.name} is {g.value:.3g}, wanted {g.limit}: {g.advice}" for g in failed),
        "camera": None if failed else camera_to_dict(found.camera),
        "lens": {
            "corners": int(fit.used.sum()),
            "clipped": int((~fit.used).sum()),
            "rms_px": fit.rms_px,
            "held_out_rms_px": fit.held_out_rms_px,
            "models": [vars(candidate) for candidate in fit.candidates],
        },
        "gates": [
            {"name": g.name, "value": float(g.value), "limit": g.limit, "passed": bool(g.passed)} for g in found.gates
        ],
        "images": [{"image": image} for image in found.images],
        "refused": [vars(refused) for refused in found.refused],
        "provenance": {"version": __version__},
    }


def board_line(found: BoardCalibration, name: str) -> str:
    """One line for people."""
    fit, camera = found.fit, found.camera
    verdict = "ok" if found.accepted else f"refused {found.failed[0].reason}"
    return (
        f"{name}  {verdict}  {len(found.images)} of {len(found.images) + len(found.refused)} pictures  "
        f"{int(fit.used.sum())} corners  held-out {fit.held_out_rms_px:.2f} px  f {camera.focal_px[0]:.2f} px/rad  "
        f"calibrated to {np.degrees(camera.calibrated_angle_rad):.1f}°"
    )
