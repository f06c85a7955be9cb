"""Tracks with images from elsewhere, or with odometry that is wrong as a whole: what they answer, and what is wrong.

    python benchmarks/mixed_tracks.py [--draws 20] [--terrain NAME ...] [--class NAME ...]

Drives of 7 images 80 m apart with a corner, with evidence that is simulated as in drives.py: 5 sigma at V 6. A pose is
wrong if it is off by more than twice its 99.9 % circle from where the rover was at the time that its image states.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from _drive_frames import Course, draw_course, frames_by_evidence
from _results import table, write_section
from drives import RADIUS_M, SLOPE_RAD
from scipy.spatial.transform import Rotation

from startrack.applications.tracking import ObservedFrame, Odometry, estimate_track
from startrack.applications.tracking.frame_estimate import estimate_frame
from startrack.core.errors import BadInput
from startrack.core.types import Array
from startrack.estimation.observations import USUAL_ODOMETRY
from startrack.frames import (
    R_body_enu_from_heading_pitch_roll,
    R_enu_icrs,
    azel_from_rays,
    quat_xyzw_from_R,
    rays_from_azel,
)
from startrack.rendering.series import draw_odometry
from startrack.terrain import load_terrain

FRAMES, SPACING_M, EVERY_S = 7, 80.0, 1600.0
CORNER, TURN_RAD = 4, np.radians(70.0)  # number of the frame at which the rover turns
TILT_RAD = np.radians(5.0)
POSES_A_STEP, STEPS_BEYOND = 8, 3  # of the odometry, which begins before the first image and ends after the last
TERRAINS = ("shackleton-thesis", "shackleton-rendered")
SEED = 47


@dataclass(frozen=True, eq=False)
class Draw:
    """One drive, and what a track gets of it."""

    course: Course
    frames: list[ObservedFrame]
    odometry: Odometry


Change = Callable[[Draw, np.random.Generator], Draw]
Observe = Callable[[Course, np.random.Generator], Iterable[ObservedFrame]]


def draw_drive(
    terrain: str, rng: np.random.Generator, frames: int = FRAMES, observe: Observe = frames_by_evidence
) -> Draw:
    """A drive with the usual errors of its odometry."""
    stated = load_terrain(terrain)
    course = draw_course(stated, stated, 0.0, frames=frames, spacing_m=SPACING_M, every_s=EVERY_S,
                         radius_m=RADIUS_M, slope_rad=SLOPE_RAD, rng=rng)  # fmt: skip
    turn = rng.choice([-1.0, 1.0]) * TURN_RAD
    step = course.position_m[1] - course.position_m[0]
    turned = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) @ step
    number = np.arange(-STEPS_BEYOND, frames + STEPS_BEYOND, 1.0 / POSES_A_STEP)
    path = course.position_m[0] + np.minimum(number, CORNER)[:, None] * step
    path += np.maximum(number - CORNER, 0.0)[:, None] * turned
    heading = np.where(number < CORNER, np.arctan2(*step), np.arctan2(*turned))
    R = np.array([R_body_enu_from_heading_pitch_roll(a, *rng.normal(0.0, TILT_RAD, 2)) for a in heading])
    errors = replace(USUAL_ODOMETRY, sigma_1=USUAL_ODOMETRY.sigma_1 * POSES_A_STEP**0.5)
    position_m, R_own_body = draw_odometry(np.pad(path, ((0, 0), (0, 1))), R, errors=errors, rng=rng)
    at = np.searchsorted(number, np.arange(frames))
    course = replace(course, position_m=path[at])
    observed = [replace(frame, R_body_enu=r) for frame, r in zip(observe(course, rng), R[at], strict=True)]
    time_s = course.time_utc[0].timestamp() + EVERY_S * number
    quat = np.array([quat_xyzw_from_R(one) for one in R_own_body])
    return Draw(course, observed, Odometry(time_s=time_s, position_m=position_m, quat_xyzw=quat))


def with_foreign(count: int, *, of_one_drive: bool) -> Change:
    """So many images at random are those of another drive in the same form, or each from another place."""

    def change(draw: Draw, rng: np.random.Generator) -> Draw:
        which = np.sort(rng.choice(FRAMES, count, replace=False))
        away, frames = draw.course.position_m - draw.course.position_m[0], list(draw.frames)
        turn, middle = _turn(rng), _place(rng)
        for k in which.tolist():
            if not of_one_drive:
                turn, middle = _turn(rng), _place(rng)
            position = middle + away @ turn[:2, :2].T
            course = replace(draw.course, position_m=position[k : k + 1], time_utc=draw.course.time_utc[k : k + 1])
            found, R = next(frames_by_evidence(course, rng)), draw.frames[k].R_body_enu
            assert R is not None
            frames[k] = replace(found, name=f"foreign-{k}", R_body_enu=R @ turn.T)
        return replace(draw, frames=frames)

    return change


def _turn(rng: np.random.Generator) -> Array:
    return np.asarray(Rotation.from_rotvec([0.0, 0.0, rng.uniform(0.0, 2.0 * np.pi)]).as_matrix())


def _place(rng: np.random.Generator) -> Array:
    return rng.uniform(-0.7 * RADIUS_M, 0.7 * RADIUS_M, 2)


def swap_times(draw: Draw, rng: np.random.Generator) -> Draw:
    """Two images have the time of each other."""
    first, second = rng.choice(FRAMES, 2, replace=False).tolist()
    site, frames, course = draw.course.stated.site, list(draw.frames), draw.course
    assert site is not None
    for k, other in ((first, second), (second, first)):
        frame, evidence = draw.frames[k], draw.frames[k].evidence
        assert evidence is not None and frame.R_body_enu is not None
        turn = R_enu_icrs(site, course.time_utc[other]) @ R_enu_icrs(site, course.time_utc[k]).T
        azimuth, elevation = azel_from_rays(rays_from_azel(evidence.azimuth_rad, evidence.elevation_rad) @ turn.T)
        rows = replace(evidence, azimuth_rad=azimuth, elevation_rad=elevation)
        found = estimate_frame(rows, course.stated, course.shared, frame.modes[0].mean[:2], 400.0 * np.eye(2))
        frames[other] = replace(frame, name=f"swapped-{k}", time_utc=course.time_utc[other], modes=(found,),
                                evidence=rows, R_body_enu=frame.R_body_enu @ turn.T)  # fmt: skip
    return replace(draw, frames=frames)


def with_odometry(change: Callable[[Array, Array, Rotation], tuple[Array, Array, Rotation]]) -> Change:
    """The odometry with its positions, attitudes and times changed."""

    def changed(draw: Draw, rng: np.random.Generator) -> Draw:
        one = draw.odometry
        position, time_s, attitude = change(
            *map(np.array, (one.position_m, one.time_s)), Rotation.from_quat(one.quat_xyzw)
        )
        order = np.argsort(time_s)
        return replace(draw, odometry=Odometry(
            time_s=time_s[order], position_m=position[order], quat_xyzw=attitude.as_quat()[order])
        )  # fmt: skip

    return changed


CLASSES: dict[str, Change] = {
    "true odometry": lambda draw, rng: draw,
    **{f"{n} of 7 images from elsewhere": with_foreign(n, of_one_drive=False) for n in (1, 2, 3)},
    **{f"{n} of 7 images of another drive": with_foreign(n, of_one_drive=True) for n in (2, 3)},
    "times of two images swapped": swap_times,
    "odometry: opposite sign": with_odometry(lambda p, t, q: (-p, t, q)),
    "odometry: backwards in time": with_odometry(lambda p, t, q: (p, t[0] + t[-1] - t, q)),
    "odometry: x and y swapped": with_odometry(lambda p, t, q: (p[:, [1, 0, 2]], t, q)),
    "odometry: x and z swapped": with_odometry(lambda p, t, q: (p[:, [2, 1, 0]], t, q)),
    "odometry: quaternions w first": with_odometry(
        lambda p, t, q: (p, t, Rotation.from_quat(np.roll(q.as_quat(), 1, axis=1)))
    ),
    "odometry: quaternions reversed": with_odometry(lambda p, t, q: (p, t, Rotation.from_quat(q.as_quat()[:, ::-1]))),
    "odometry: inverse quaternions": with_odometry(lambda p, t, q: (p, t, q.inv())),
    "odometry: inverse poses": with_odometry(lambda p, t, q: (-q.inv().apply(p), t, q.inv())),
    "odometry: in mm": with_odometry(lambda p, t, q: (1e3 * p, t, q)),
    "odometry: in km": with_odometry(lambda p, t, q: (1e-3 * p, t, q)),
    "odometry: in feet": with_odometry(lambda p, t, q: (p / 0.3048, t, q)),
    "odometry: 10 % too long": with_odometry(lambda p, t, q: (1.1 * p, t, q)),
    "odometry: half as long": with_odometry(lambda p, t, q: (0.5 * p, t, q)),
    "odometry: 5 degrees turned": with_odometry(lambda p, t, q: (p, t, q * Rotation.from_rotvec([0.0, 0.0, 0.087]))),
    "odometry: 20 degrees turned": with_odometry(lambda p, t, q: (p, t, q * Rotation.from_rotvec([0.0, 0.0, 0.35]))),
    "odometry: zero": with_odometry(lambda p, t, q: (0.0 * p, t, q)),
    **{
        f"odometry: stamps {part:+g} of an interval": with_odometry(lambda p, t, q, s=part * EVERY_S: (p, t + s, q))
        for part in (-1.0, -0.3, 0.3, 1.0, 2.0)
    },
}


def score(draw: Draw) -> dict[str, float]:
    """Of one track: whether it is answered, images used, and the largest error of a pose in its 99.9 % circles."""
    try:
        track = estimate_track(draw.frames, draw.course.stated, draw.course.shared, odometry=draw.odometry)
    except BadInput as refusal:
        print(f"  {refusal.reason}: {refusal}")
        return {"answered": 0.0, "used": 0.0, "right": 0.0, "fault": 0.0, "circles": 0.0, "filtered": 0.0, "m": 0.0}
    worst = {}
    for name, found in (("circles", track.smoothed), ("filtered", track.filtered)):
        off = np.linalg.norm(found.position_enu_m[:, :2] - draw.course.position_m, axis=1)
        worst[name] = float(np.nanmax(off / found.radius999_m))
        worst["m"] = max(worst.get("m", 0.0), float(np.nanmax(off))) if name == "circles" else worst["m"]
    used = [frame.status == "used" for frame in track.frames]
    right = [is_used and frame.name.startswith("frame") for is_used, frame in zip(used, track.frames, strict=True)]
    return {"answered": 1.0, "used": float(sum(used)), "right": float(sum(right)),
            "fault": float(bool(track.odometry_fault)), **worst}  # fmt: skip


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--terrain", action="append", choices=TERRAINS)
    parser.add_argument("--class", dest="classes", action="append", choices=CLASSES)
    args = parser.parse_args()
    lines = []
    for terrain in args.terrain or TERRAINS:
        draws = [draw_drive(terrain, np.random.default_rng([SEED, number])) for number in range(args.draws)]
        for name in args.classes or CLASSES:
            rows = []
            for number, draw in enumerate(draws):
                rng = np.random.default_rng([SEED, number, list(CLASSES).index(name)])
                rows.append(score(CLASSES[name](draw, rng)))
            answered = [row for row in rows if row["answered"]]
            beyond = [sum(row[key] > times for row in rows) for key, times in
                      (("circles", 1.0), ("circles", 2.0), ("filtered", 2.0))]  # fmt: skip
            lines.append([
                terrain, name, str(len(rows)), str(len(answered)),
                f"{np.mean([row['used'] for row in answered]):.1f}" if answered else "",
                str(sum(row["fault"] > 0 for row in rows)), *map(str, beyond),
                f"{max(row['m'] for row in rows):.0f}",
            ])  # fmt: skip
            print(lines[-1], flush=True)
    head = ["terrain", "class", "tracks", "answered", "images used", "without the odometry", "with a pose beyond its "
            "99.9 % circle", "beyond twice it", "the same, filtered", "largest error, m"]  # fmt: skip
    body = table(head, lines)
    print(body)
    if not (args.classes or args.terrain):
        write_section("Mixed tracks", f"python benchmarks/mixed_tracks.py --draws {args.draws}",
                      ("numpy", "scipy"), body)  # fmt: skip


if __name__ == "__main__":
    main()
