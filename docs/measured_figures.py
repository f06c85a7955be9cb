"""The figures of docs/how-good.md and docs/results.md, taken from the stored results (benchmarks/results/)."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent.parent / "benchmarks/results"
PAGE = "../benchmarks/RESULTS.md"


@dataclass(frozen=True)
class Figure:
    """One line of the page: a question, and the answer by cells of a row of a result's table."""

    question: str
    section: str
    row: tuple[str, ...]  # its first cells; empty: the answer is made of the section's first text
    answer: str  # column names, or a pattern with groups for the text, in braces

    def line(self) -> str:
        """The line of the table."""
        link = f"[{self.section}]({PAGE}#{re.sub(r'[^a-z0-9 -]', '', self.section.lower()).replace(' ', '-')})"
        return f"| {self.question} | {self.answer_text()} | {link}, {result_of(self.section)['date']} |"

    def answer_text(self) -> str:
        """The answer with its numbers."""
        stored = result_of(self.section)
        if not self.row:
            return str(next(one["text"] for one in stored["blocks"] if "text" in one)).rstrip(".")
        for block in stored["blocks"]:
            for row in block.get("rows", []):
                if tuple(row[: len(self.row)]) == self.row:
                    cells = dict(reversed(list(zip(block["head"], row, strict=True))))
                    return re.sub(r"\{([^}]+)\}", lambda found, cells=cells: cells[found[1]], self.answer)
        raise LookupError(f"{self.section} has no row {self.row}")


GROUND, SHACKLETON = "Ground that is not the map's", "Shackleton's floor"
ERROR_BEYOND = "{mean error, m} m; NEES {mean NEES}; {beyond the 99.9 % circle} of {answered} beyond the 99.9 % circle"
SLIPPED = (
    "{mean error, m} m; {drives with a pose beyond its 99.9 % circle} of {drives} drives beyond a 99.9 % circle; "
    "leg and factor named in {the first leg named, its factor within 5 %}"
)
GROUPS: dict[str, tuple[Figure, ...]] = {
    "Position from one picture": (
        Figure("Thesis's crater, stars alone, 5 sigma at magnitude 6", "Evidence, part by part",
               ("6.0", "without remeasuring near the skyline"),
               "{mean, m} m; NEES {NEES} (2 is perfect); {95 %} % in the 95 % circle, {frames} frames"),
        Figure("Stars and the sky's light, 5 sigma at magnitude 7.5", "Depth", ("7.5", "as deep as the frame"),
               "{mean, m} m; NEES {NEES}; {95 %} % in the 95 % circle, {frames} frames"),
        Figure("Thesis's crater, magnitude 6, stars and the sky's light (7 % of the background)", "Chain",
               ("startrack",), "{mean} m; median {median} m, largest {max} m, 50 frames"),
        Figure("The same 50 pictures by Kua's method of 2008 (pseudo-gradient)", "Chain",
               ("pseudo-gradient (Kua 2008)",), "{mean} m; median {median} m"),
        Figure("Thesis's crater, light of the sky 30 % of the background", GROUND, ("dark", "30 %"), ERROR_BEYOND),
        Figure(f"{SHACKLETON}, ground as the map has it, stars alone", "Height maps: shackleton", ("the map as it is",),
               "{mean error, m} m; largest {largest} m; NEES {NEES}; {in it} in the 95 % circle, {located} located"),
        Figure(f"{SHACKLETON}, ground by another program's horizon, sky 7 %", GROUND, ("reference", "7 %"),
               ERROR_BEYOND),
        Figure(f"The worst case: {SHACKLETON} with a step of 5 to 20 m in the map, of which the file says nothing",
               GROUND, ("seam", "7 %"), ERROR_BEYOND),
        Figure("A valley of the Earth at night, horizons of 9 to 26 degrees", "Valleys of the Earth", ("exact map",),
               "{mean error, m} m; NEES {NEES}; {answered} answered"),
    ),
    "Real pictures": (
        Figure("Real starlight over invented craters", "Real starlight", (), ""),
        Figure("Real skyline by day (Finse, snow), attitude known to 0.02 degrees", "Real ground",
               ("2019-05-24, snow", "0.02, 0.02"),
               "{along the line of sight, m} m along, {across, m} m across the line of sight; "
               "its 95 % circle: {95 %, m} m"),
        Figure("The same, heading open and tilt to 3 degrees", "Real ground", ("2019-05-24, snow", "180, 3"),
               "{along the line of sight, m} m along, {across, m} m across; its 95 % circle: {95 %, m} m"),
        Figure("Horizon of an all-sky camera, pictures against each other", "Skylines of a camera held out",
               ("single pictures, each pair",), "RMS {RMS of all} sigma over {azimuths known} azimuths"),
    ),
    "Drives": (
        Figure("Images 50 m apart on Shackleton's floor, with odometry", "Tracks from pixels", ("50 m",),
               "{one frame, m} m by one image, {filtered, m} m filtered, {smoothed, m} m smoothed"),
        Figure(f"{SHACKLETON}: a leg of 4 of 9 moves that slips by 20 %", "Slips",
               ("shackleton-rendered", "4 of 9 moves 20 % too long"), SLIPPED),
        Figure("The same in the thesis's crater", "Slips", ("shackleton-thesis", "4 of 9 moves 20 % too long"),
               SLIPPED),
        Figure("Accuracy predicted before a drive, over the one that images state", "Predictions against images",
               ("shackleton",), "{predicted / stated}; {places within 0.65 to 1.5} places within 0.65 to 1.5"),
    ),
    "Stars and lenses": (
        Figure("Lists of 8 stars and 32 false ones, 180 degrees", "Stars: identification",
               ("8 stars, 32 false", "startrack"), "{solved} solved, {wrong} wrong; {ms, median} ms"),
        Figure("The same by ruststartracker, at its setting that solves most of them", "Stars: identification",
               ("8 stars, 32 false", "ruststartracker (V < 3.5, 60 degrees)"),
               "{solved} solved, {wrong} wrong; {ms, median} ms"),
        Figure("Lists of stars, fields of 10 to 180 degrees, false and missing stars", "Stars: identification", (), ""),
        Figure("A lens from one frame of 100 stars", "Calibration", ("1 frame, 100 stars, 0.2 px", "equidistant"),
               "{map error px: median} px (median of {trials})"),
        Figure("Centroids, SNR 10 to 300", "Stars: detection", ("startrack",),
               "RMS {centroid RMS / bound, SNR 10-20 / 20-50 / 50-100 / 100-300} of the bound; "
               "{time against sep} of the time of sep"),
    ),
    "Speed and safety": (
        Figure("CPU of one warm frame, file to position, in times of sep's extraction alone", "One frame",
               ("total over sep",), "{median}"),
        Figure("Mutated PNG files", "Mutated files", ("png",),
               "{tried} tried: {internal errors} internal errors, {hangs} hangs"),
    ),
}  # fmt: skip


FRONT_PAGE = ("Evidence, part by part", "Chain")  # sections whose figures README.md states


QUESTIONS = (  # of docs/results.md, with a figure that answers each
    ("How far off is a position from one picture?", "Position from one picture", 2),
    ("And by Kua's method of 2008?", "Position from one picture", 3),
    ("On ground that another program traced?", "Position from one picture", 6),
    ("Under real starlight?", "Real pictures", 0),
    ("By a real skyline?", "Real pictures", 1),
    ("On a drive with odometry?", "Drives", 0),
    ("Is the accuracy predicted rightly?", "Drives", 3),
    ("Are lists of stars solved wrongly?", "Stars and lenses", 2),
    ("How well is a lens known from one frame?", "Stars and lenses", 3),
    ("How much CPU does a picture take, over sep's extraction?", "Speed and safety", 0),
)


def question_table() -> str:
    """Questions, answers and the commands that measure them."""
    rows = ["| question | answer | command |", "| --- | --- | --- |"]
    for question, group, number in QUESTIONS:
        figure = GROUPS[group][number]
        rows.append(f"| {question} | {figure.answer_text()} | `{result_of(figure.section)['command']}` |")
    return "\n".join(rows) + "\n"


def cited_sections() -> set[str]:
    """Sections whose figures the page and README.md state."""
    return {one.section for figures in GROUPS.values() for one in figures} | set(FRONT_PAGE)


@cache
def result_of(section: str) -> dict[str, Any]:
    """The stored result of a section."""
    for path in RESULTS.glob("*.json"):
        stored: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if stored["section"] == section:
            return stored
    raise LookupError(f"no result is stored for {section}")


def figure_tables() -> str:
    """The tables of the page, one for each group."""
    parts = []
    for title, figures in GROUPS.items():
        head = ["| what | figure | measured by, on |", "| --- | --- | --- |"]
        parts.append("\n".join([f"## {title}", "", *head, *(one.line() for one in figures)]))
    return "\n\n".join(parts) + "\n"
