"""Tracks of drives whose wheels slip for some moves: errors of poses, and how many lie beyond their circles.

    python benchmarks/slips.py [--drives 20] [--terrain NAME ...] [--class NAME ...]

Drives of 10 images 80 m apart with a corner; the evidence is simulated as in mixed_tracks.py, and each image is located
by itself in the whole search area. In the moves of a leg at a random place the odometry is too long, or turned from
the heading of the body, beside its usual errors.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace

import numpy as np
from _drive_frames import frames_by_fixes
from _results import table, write_section
from mixed_tracks import EVERY_S, TERRAINS, Draw, draw_drive
from scipy.spatial.transform import Rotation

from startrack.applications.tracking import Odometry, Track, Trajectory, estimate_track

FRAMES, SEED = 10, 53


@dataclass(frozen=True)
class Slip:
    """A leg of so many moves, by its factor on the length and its heading."""

    moves: int = 0
    factor_1: float = 1.0
    turned_deg: float = 0.0


NAMED_PART = 0.05  # of a leg's factor
CLASSES: dict[str, tuple[Slip, ...]] = {
    "none": (),
    "4 of 9 moves 20 % too long": (Slip(4, 1.2),),
    "3 of 9 moves turned by 3 degrees": (Slip(3, 1.0, 3.0),),
    "4 of 9 moves 20 % too long, 3 others turned by 3 degrees": (Slip(4, 1.2), Slip(3, 1.0, 3.0)),
    "4 of 9 moves 10 % too short": (Slip(4, 0.9),),
    "1 of 9 moves 50 % too long": (Slip(1, 1.5),),
}


def places_of(slips: tuple[Slip, ...], rng: np.random.Generator) -> list[int]:
    """Numbers of the first moves of legs one after the other, at random places that do not overlap."""
    free = FRAMES - 1 - sum(one.moves for one in slips)
    before = np.cumsum([0, *(one.moves for one in slips)])[: len(slips)]
    return [int(k) for k in np.sort(rng.integers(0, free + 1, len(slips))) + before]


def with_slips(draw: Draw, slips: tuple[Slip, ...], rng: np.random.Generator) -> Draw:
    """The drive with legs at random places."""
    odometry, start_s = draw.odometry, draw.course.time_utc[0].timestamp()
    for slip, first in zip(slips, places_of(slips, rng), strict=True):
        odometry = slipped(odometry, start_s + EVERY_S * first, start_s + EVERY_S * (first + slip.moves), slip)
    return replace(draw, odometry=odometry)


def is_named(track: Track, slips: tuple[Slip, ...], rng: np.random.Generator) -> bool:
    """Whether a leg of the track has most of the moves of the first slip, and its factor to NAMED_PART."""
    return any(
        2 * len({*range(leg.first, leg.last)} & {*range(first, first + slip.moves)}) > slip.moves
        and abs(leg.factor_1 / slip.factor_1 - 1.0) <= NAMED_PART
        for slip, first in zip(slips[:1], places_of(slips, rng), strict=False) for leg in track.legs
    )  # fmt: skip


def slipped(odometry: Odometry, first_s: float, last_s: float, slip: Slip) -> Odometry:
    """The odometry whose moves between two times are as by a `slip`."""
    time_s, move_m = np.array(odometry.time_s), np.diff(np.array(odometry.position_m), axis=0)
    middle_s = 0.5 * (time_s[1:] + time_s[:-1])
    slips = (middle_s > first_s) & (middle_s < last_s)
    # About the vertical of the odometry's own frame, which is level.
    turned = slip.factor_1 * Rotation.from_rotvec([0.0, 0.0, np.radians(slip.turned_deg)]).apply(move_m)
    moves = np.where(slips[:, None], turned, move_m)
    position_m = odometry.position_m[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(moves, axis=0)])
    return replace(odometry, position_m=position_m)


def off_m(found: Trajectory, draw: Draw) -> np.ndarray:
    """(n,) errors [m]; nan where no position is known."""
    return np.asarray(np.linalg.norm(found.position_enu_m[:, :2] - draw.course.position_m, axis=1))


def score(track: Track, draw: Draw) -> dict[str, float]:
    """Of one track: mean and largest errors [m], and the largest error of a pose in its 99.9 % circles."""
    found = {}
    for name, one in (("smoothed", track.smoothed), ("filtered", track.filtered)):
        off = off_m(one, draw)
        found |= {f"{name} m": float(np.nanmean(off)), f"{name} largest": float(np.nanmax(off)),
                  f"{name} circles": float(np.nanmax(off / one.radius999_m))}  # fmt: skip
    single = [
        np.linalg.norm(frame.fixes[0].position_enu_m[:2] - at)
        for frame, at in zip(draw.frames, draw.course.position_m, strict=True) if len(frame.fixes) == 1
    ]  # fmt: skip
    used = [frame.status == "used" for frame in track.frames]
    return {"single m": float(np.mean(single)), "used": float(sum(used)), "fault": float(bool(track.odometry_fault)),
            "slips": float(track.slipped.sum()), **found}  # fmt: skip


def draws_of(terrain: str, count: int) -> list[Draw]:
    """Drives without slips."""
    return [
        draw_drive(terrain, np.random.default_rng([SEED, number]), FRAMES, frames_by_fixes) for number in range(count)
    ]


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=20)
    parser.add_argument("--terrain", action="append", choices=TERRAINS)
    parser.add_argument("--class", dest="classes", action="append", choices=CLASSES)
    args = parser.parse_args()
    lines = []
    for terrain in args.terrain or TERRAINS:
        draws = draws_of(terrain, args.drives)
        for name in args.classes or CLASSES:
            rows = []
            for number, draw in enumerate(draws):
                changed = with_slips(draw, CLASSES[name], np.random.default_rng([SEED, 1, number]))
                track = estimate_track(
                    changed.frames, changed.course.stated, changed.course.shared, odometry=changed.odometry
                )
                named = is_named(track, CLASSES[name], np.random.default_rng([SEED, 1, number]))
                rows.append(score(track, changed) | {"named": float(named)})
            lines.append([
                terrain, name, str(len(rows)), f"{np.mean([row['used'] for row in rows]):.1f}",
                f"{np.mean([row['slips'] for row in rows]):.1f}",
                str(int(sum(row["named"] for row in rows))) if CLASSES[name] else "",
                f"{np.mean([row['single m'] for row in rows]):.1f}",
                *(text for kind in ("smoothed", "filtered") for text in (
                    f"{np.mean([row[f'{kind} m'] for row in rows]):.1f}",
                    f"{max(row[f'{kind} largest'] for row in rows):.0f}",
                    *(str(sum(row[f"{kind} circles"] > times for row in rows)) for times in (1.0, 2.0)),
                )),
            ])  # fmt: skip
            print(lines[-1], flush=True)
    errors = ["mean error, m", "largest, m", "drives with a pose beyond its 99.9 % circle", "beyond twice it"]
    named = f"the first leg named, its factor within {100 * NAMED_PART:.0f} %"
    head = ["terrain", "class", "drives", "images used", "moves judged slip", named, "mean error of single images, m",
            *errors, *(f"filtered: {text}" for text in errors)]  # fmt: skip
    body = table(head, lines)
    print(body)
    if not (args.classes or args.terrain):
        write_section("Slips", f"python benchmarks/slips.py --drives {args.drives}", ("numpy", "scipy"), body)


if __name__ == "__main__":
    main()
