"""A picture to draw on: anti-aliased shapes at sub-pixel places (OpenCV), texts that stay clear, axes of plots."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from startrack.core.types import Array

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont


Colour = tuple[int, int, int]
Box = tuple[float, float, float, float]  # left, top, right, bottom
Legend = list[tuple[str, Colour, str]]  # kind of a mark, its colour, words


def rgb_colours(codes: str) -> list[Colour]:
    """The colours of hexadecimal `codes`."""
    return [(code[0], code[1], code[2]) for code in map(bytes.fromhex, codes.split())]


class Ink:
    """The colours of all pictures: of writing, of the ground, and of marks (Okabe and Ito's, which all can tell)."""

    PLAIN, DIM, FAINT, GRID = rgb_colours("ecf0f5 97a3b4 4a5668 2c3544")
    PAPER, PANEL, FLOOR, WALL = rgb_colours("0d1119 131924 1b2433 131112")
    SKY_DARK, SKY_BRIGHT, STARLIGHT, SHADOW = rgb_colours("0e1421 22304e fffdf8 080b11")
    GREEN, ORANGE, BLUE, YELLOW, VERMILLION, PURPLE = rgb_colours("009e73 e69f00 56b4e9 f0e442 d55e00 cc79a7")
    IDENTIFIED, HIDDEN, DETECTION, BODY = GREEN, ORANGE, DIM, YELLOW
    SKYLINE, MEASURED, POSITION, TRUTH = BLUE, PLAIN, VERMILLION, PURPLE


def mix_colours(a: Colour, b: Colour, part_of_b: float) -> Colour:
    """Colour between `a` and `b`: `part_of_b` 0 is a, 1 is b."""
    r, g, blue = (round((1 - part_of_b) * x + part_of_b * y) for x, y in zip(a, b, strict=True))
    return r, g, blue


TEXT_PX = 16.0  # size of writing; distances between things are multiples of it
LARGE_PX, TITLE_PX = 1.25 * TEXT_PX, 1.5 * TEXT_PX
LINE_PX = 1.5 * TEXT_PX  # from line to line
SHIFT_BITS = 4  # OpenCV takes sub-pixel places as integers of 1/16 px
EDGE_PX = 0.4  # added by OpenCV's smoothing to the edge of an area
FARTHEST_PX = 30_000.0  # beyond any picture, within OpenCV's range
QUALITY = 85  # of JPEG: 270 kB of 1400 x 1400 px, in 10 ms; and of WebP, which has 150 kB and takes 200 ms
KNOWN_BEYOND_ASCII = "±°·…"
STROKES: dict[str, Any] = {  # of marks, within half a unit to each side
    "cross": (((-1, -1), (1, 1)), ((-1, 1), (1, -1))), "plus": (((-1, 0), (1, 0)), ((0, -1), (0, 1))),
    "line": (((-1, 0), (1, 0)),),
}  # fmt: skip


class Canvas:
    """Pixels (H, W, 3), red, green, blue. Place (0, 0) is the centre of the top-left pixel; texts appear at the end."""

    def __init__(self, width: int, height: int, colour: Colour = Ink.PAPER) -> None:
        self.pixels: NDArray[np.uint8] = np.full((height, width, 3), colour, dtype=np.uint8)
        self._origin = np.zeros(2)
        self._texts: list[tuple[tuple[float, float], str, str, float, Colour, bool]] = []  # arguments of `text`
        self._occupied: list[Box] = []

    def window(self, box: Box) -> Canvas:
        """The same picture, in the same places, with shapes clipped to the box."""
        left, top, right, bottom = (round(edge) for edge in box)
        window = copy(self)
        window.pixels = self.pixels[top : bottom + 1, left : right + 1]
        window._origin = self._origin + np.array([left, top])
        return window

    @property
    def size(self) -> tuple[int, int]:
        """(W, H)."""
        return self.pixels.shape[1], self.pixels.shape[0]

    def line(
        self, points: ArrayLike, colour: Colour, width: int = 1, closed: bool = False, dashed: bool = False
    ) -> None:
        """A line of a `colour` and `width` [px] through the `points` (n, 2); `closed` joins the last to the first.

        `dashed`: every other stretch of it alone.
        """
        places = self._to_fixed_point(points)
        parts = [places[k : k + 2] for k in range(0, len(places) - 1, 2)] if dashed else [places]
        cv2.polylines(self.pixels, parts, closed, colour, width, cv2.LINE_AA, SHIFT_BITS)

    def area(self, points: ArrayLike, colour: Colour) -> None:
        """A convex or plain polygon with corners `points` (n, 2), filled with a `colour`."""
        cv2.fillPoly(self.pixels, [self._to_fixed_point(points)], colour, cv2.LINE_AA, SHIFT_BITS)

    def curve(self, points: ArrayLike, colour: Colour, width: float, closed: bool = False) -> None:
        """A smooth curve with the arguments of `line`: `points`, `colour`, `width`, `closed`.

        It is a filled ribbon: OpenCV's own thick lines look beaded.
        """
        places = np.asarray(points, dtype=float)
        ahead, behind = np.roll(places, -1, axis=0), np.roll(places, 1, axis=0)
        if not closed:
            ahead[-1], behind[0] = places[-1], places[0]
        along = ahead - behind
        along /= np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)[:, None]
        aside = (0.5 * width - EDGE_PX) * np.stack([-along[:, 1], along[:, 0]], axis=-1)
        left, right = self._to_fixed_point(places + aside), self._to_fixed_point(places - aside)
        outline = [left, right] if closed else [np.concatenate([left, right[::-1]])]
        cv2.fillPoly(self.pixels, outline, colour, cv2.LINE_AA, SHIFT_BITS)

    def circle(self, centre: ArrayLike, radius: float, colour: Colour, width: int = 1) -> None:
        """A circle of `radius` [px] and `colour`; filled where `width` is negative."""
        if not 0 <= radius < FARTHEST_PX:
            return
        if width > 1:
            turn = np.linspace(0, 2 * np.pi, int(np.clip(4 * radius, 24, 360)), endpoint=False)
            ring = radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
            self.curve(np.asarray(centre) + ring, colour, width, closed=True)
            return
        x, y = (  # of one place: numpy takes five times as long
            round(min(max(at - start, -FARTHEST_PX), FARTHEST_PX) * 2**SHIFT_BITS)
            for at, start in zip(np.asarray(centre, dtype=float).tolist(), self._origin.tolist(), strict=True)
        )
        reach = round(radius * 2**SHIFT_BITS)
        cv2.circle(self.pixels, (x, y), reach, colour, width, cv2.LINE_AA, SHIFT_BITS)

    def mark(self, at: ArrayLike, kind: str, half: float, colour: Colour, width: int = 2) -> None:
        """A mark of half size `half` [px] at a place, in lines of a `colour` and `width` [px].

        `kind`: ring, disc, place (both), cross (x), plus, line, box (filled), diamond, or square (a filled diamond).
        """
        place = np.asarray(at, dtype=float)
        if kind in ("ring", "place"):
            self.circle(place, half, colour, width)
        if kind in ("disc", "place"):
            self.circle(place, half if kind == "disc" else half / 2, colour, -1)
        for stroke in STROKES.get(kind, ()):
            self.line(place + half * np.array(stroke), colour, width)
        if kind == "box":
            self.rectangle(box_around(place, half), colour)
        if kind in ("diamond", "square"):
            corners = place + half * np.array([(0, -1), (1, 0), (0, 1), (-1, 0)])
            self.line(corners, colour, width, closed=True) if kind == "diamond" else self.area(corners, colour)

    def rectangle(self, box: Box, colour: Colour, width: int = -1) -> None:
        """A `box` of a `colour`; filled where `width` is negative."""
        left, top, right, bottom = self._to_fixed_point(np.reshape(box, (2, 2))).ravel().tolist()
        cv2.rectangle(self.pixels, (left, top), (right, bottom), colour, width, cv2.LINE_8, SHIFT_BITS)

    def text(
        self, xy: ArrayLike, text: str, colour: Colour = Ink.DIM, anchor: str = "ls", size: float = TEXT_PX,
        halo: bool = False,
    ) -> Box:  # fmt: skip
        """Write `text` of `size` [px] at `xy`, where `label` then writes nothing; returns the box.

        `anchor` is the place of `xy` in the text: l, m or r, and t (top), m or s. `halo` adds a dark edge to
        letters of any `colour`.
        """
        x, y = (float(c) for c in np.asarray(xy, dtype=float))
        self._texts.append(((x, y), printable(text), anchor, size, colour, halo))
        self._occupied.append(text_box((x, y), text, anchor, size))
        return self._occupied[-1]

    def paragraph(
        self, left: float, y: float, text: str, width: float, colour: Colour = Ink.DIM, size: float = TEXT_PX
    ) -> float:
        """Write `text` of `size` [px] in lines of at most `width` [px] from the first at `y` on; where the next stands.

        `left` and `colour` are those of every line.
        """
        for line in wrap_text(text, size, width):
            self.text((left, y), line, colour, size=size)
            y += LINE_PX / TEXT_PX * size
        return y

    def legend(self, left: float, y: float, width: float, entries: Legend) -> float:
        """Marks and words of a legend's `entries` in `width` [px], in lines from `y` on; where the next would stand."""
        for kind, colour, words in entries:
            half = TEXT_PX / (8 if kind == "disc" else 2)
            self.mark((left + TEXT_PX / 2, y - TEXT_PX / 3), kind, half, colour)
            y = self.paragraph(left + 2 * TEXT_PX, y, words, width - 2 * TEXT_PX)
        return y

    def label(self, at: ArrayLike, text: str, colour: Colour, gap: float, within: Box, size: float = TEXT_PX) -> bool:
        """Write `text` of `size` [px] and `colour` beside the place `at`, a `gap` [px] off, inside the box `within`.

        It stands at the first of eight sides that is free; False where there is none.
        """
        x, y = (float(c) for c in np.asarray(at, dtype=float))
        near = 0.75 * gap
        for dx, dy, anchor in (
            (gap, 0.0, "lm"), (-gap, 0.0, "rm"), (near, -near, "ls"), (near, near, "lt"), (-near, -near, "rs"),
            (-near, near, "rt"), (0.0, -gap, "ms"), (0.0, gap, "mt"),
        ):  # fmt: skip
            left, top, right, bottom = text_box((x + dx, y + dy), text, anchor, size)
            box = left - 2, top - 2, right + 2, bottom + 2
            inside = box[0] >= within[0] and box[1] >= within[1] and box[2] <= within[2] and box[3] <= within[3]
            if inside and self.is_free(box):
                self.text((x + dx, y + dy), text, colour, anchor, size, halo=True)
                return True
        return False

    def is_free(self, box: Box) -> bool:
        """Whether no text and nothing kept free overlaps the box."""
        left, top, right, bottom = box
        return not any(left < x1 and x0 < right and top < y1 and y0 < bottom for x0, y0, x1, y1 in self._occupied)

    def reserve(self, box: Box) -> None:
        """Keep labels away from a box."""
        self._occupied.append(box)

    def _to_fixed_point(self, points: ArrayLike) -> NDArray[np.int32]:
        places = np.clip(np.asarray(points, dtype=float) - self._origin, -FARTHEST_PX, FARTHEST_PX)
        return np.rint(places * 2**SHIFT_BITS).astype(np.int32)

    def rendered_pixels(self) -> NDArray[np.uint8]:
        """The pixels with all texts."""
        from PIL import Image, ImageDraw

        picture = Image.fromarray(self.pixels)
        draw = ImageDraw.Draw(picture)
        for xy, text, anchor, size, colour, halo in self._texts:
            stroke = max(1, round(size / 10)) if halo else 0
            draw.text(xy, text, colour, _font(size), anchor, stroke_width=stroke, stroke_fill=Ink.SHADOW)
        return np.asarray(picture)


def box_around(centre: ArrayLike, half: float) -> Box:
    """The box of half size `half` [px] about the place `centre`."""
    x, y = (float(c) for c in np.asarray(centre, dtype=float))
    return x - half, y - half, x + half, y + half


def printable(text: str) -> str:
    """The text in the letters that the font has: accents are dropped, other unknown letters become question marks."""
    letters = unicodedata.normalize("NFKD", text.replace("\N{MINUS SIGN}", "-"))
    return "".join(
        " " if one.isascii() and not one.isprintable() else one if one.isascii() or one in KNOWN_BEYOND_ASCII else "?"
        for one in letters
        if not unicodedata.combining(one)
    )


def text_width(text: str, size: float) -> float:
    """Width of a text [px]."""
    return float(_font(size).getlength(text))


def text_box(xy: tuple[float, float], text: str, anchor: str, size: float) -> Box:
    """The box of a text of `size` [px] whose `anchor` is at `xy`."""
    left, top, right, bottom = _font(size).getbbox(printable(text), anchor=anchor)
    return xy[0] + left, xy[1] + top, xy[0] + right, xy[1] + bottom


def wrap_text(text: str, size: float, width: float) -> list[str]:
    """The words of `text` of `size` [px] in lines no wider than `width` [px], but for a word that alone is wider."""
    lines: list[str] = []
    for word in printable(text).split():
        longer = f"{lines[-1]} {word}" if lines else word
        lines[-1:] = [longer] if lines and text_width(longer, size) <= width else [*lines[-1:], word]
    return lines


@lru_cache(maxsize=32)
def _font(size: float) -> FreeTypeFont:
    from PIL import ImageFont

    font = ImageFont.load_default(size)
    if not isinstance(font, ImageFont.FreeTypeFont):
        raise RuntimeError("Pillow was built without FreeType: its default font cannot be scaled")
    return font


def png_bytes(picture: NDArray[np.uint8]) -> bytes:
    """A `picture` (H, W, 3), red, green, blue, as the content of a PNG file."""
    # Run lengths are smaller and quicker for flat colours.
    return encoded_bytes(".png", picture[:, :, ::-1], cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)


def encoded_bytes(suffix: str, pixels: NDArray[np.uint8], *flags: int) -> bytes:
    """The `pixels` (H, W, 3 or 4), blue first, as the content of a file with a `suffix`; `flags` are OpenCV's."""
    ok, data = cv2.imencode(suffix, pixels, flags)
    if not ok:
        raise RuntimeError(f"OpenCV could not encode a picture as {suffix}")
    return data.tobytes()


STEPS = 1.0, 2.0, 5.0  # times powers of ten
GAP_PX = TEXT_PX / 2  # between numbers and the box
ROOM_PX = {"x": 8 * TEXT_PX, "y": 5 * TEXT_PX}  # at most between two numbers


@dataclass(frozen=True)
class Axes:
    """Axes on a canvas: x to the right and y upwards, each from its first end to its last."""

    canvas: Canvas
    box: Box
    x: tuple[float, float]
    y: tuple[float, float]
    logarithmic: str = ""  # those of "xy" whose scale is logarithmic

    def canvas_px(self, x: Any, y: Any) -> Array:
        """Places (..., 2) on the canvas."""
        left, top, right, bottom = self.box
        across, up = self._part("x", x), self._part("y", y)
        return np.stack(np.broadcast_arrays(left + across * (right - left), bottom - up * (bottom - top)), axis=-1)

    def _part(self, axis: str, values: Any) -> Array:
        """Parts of the way between the ends of an axis; those of values below any logarithm are far below the box."""
        low, high = self.x if axis == "x" else self.y
        values = np.asarray(values, dtype=float)
        if axis in self.logarithmic:
            return np.asarray(np.log(np.maximum(values, 1e-9 * low) / low) / np.log(high / low))
        return np.asarray((values - low) / (high - low))

    def ticks(self, axis: str) -> Array:
        """Numbers that are easy to read, between the ends of an axis."""
        left, top, right, bottom = self.box
        (low, high), length = (self.x, right - left) if axis == "x" else (self.y, bottom - top)
        most = length / ROOM_PX[axis]
        if axis not in self.logarithmic:
            return multiples(low, high, nice_step((high - low) / most))
        powers = int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1
        every = np.array([number for number in nice_numbers(*powers) if low <= number <= high])
        return every if len(every) <= 2 * most else every[np.isclose(np.log10(every) % 1.0, 0.0)]

    @property
    def window(self) -> Canvas:
        """The canvas, with shapes clipped to the box."""
        return self.canvas.window(self.box)

    def draw_scales(
        self, caption: str, across: str, names: Iterable[tuple[str, Colour]] = (), columns: Array | None = None
    ) -> None:
        """The frame with a `caption` and coloured `names` above, grid lines with numbers, and the words `across` below.

        `columns`: values of x that have a line, in place of the `ticks`.
        """
        left, top, right, bottom = self.box
        at = self.canvas.text((left, top - GAP_PX), caption)[2]
        for name, colour in names:
            at = self.canvas.text((at + TEXT_PX, top - GAP_PX), name, colour)[2]
        self.canvas.text(((left + right) / 2, bottom + 2 * TEXT_PX), across, anchor="mt")
        columns, rows = self.ticks("x") if columns is None else columns, self.ticks("y")
        self.draw_columns(columns, [f"{value:g}" for value in columns])
        self.draw_rows(rows, [f"{value:g}" for value in rows])
        self.canvas.rectangle(self.box, Ink.FAINT, 1)

    def draw_columns(self, values: Sequence[float] | Array, texts: Iterable[str]) -> None:
        """Lines at `values` of x with `texts` below."""
        for (x, y), text in zip(self.canvas_px(values, self.y[0]), texts, strict=True):
            self.canvas.line([(x, y), (x, self.box[1])], Ink.GRID)
            self.canvas.text((x, y + GAP_PX), text, anchor="mt")

    def draw_rows(self, values: Sequence[float] | Array, texts: Iterable[str]) -> None:
        """Lines at `values` of y with `texts` to the left."""
        for (x, y), text in zip(self.canvas_px(self.x[0], values), texts, strict=True):
            self.canvas.line([(x, y), (self.box[2], y)], Ink.GRID)
            self.canvas.text((x - GAP_PX, y), text, anchor="rm")

    def draw_curve(self, x: Array, y: Array, colour: Colour, dot_px: float = 0.0) -> None:
        """A curve of a `colour` through points (n,), broken where y is not finite; dots of radius `dot_px` on it."""
        window, places, known = self.window, self.canvas_px(x, y), np.isfinite(y)
        for run in known_runs(known):
            window.curve(places[run], colour, 2.5)
        for place in places[known]:
            window.mark(place, "disc", dot_px, colour)


def known_runs(known: NDArray[np.bool_]) -> list[slice]:
    """Stretches of at least two known points."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(np.int8)))
    return [slice(first, last) for first, last in edges.reshape(-1, 2) if last - first > 1]


def nice_numbers(first_power: int, last_power: int) -> tuple[float, ...]:
    """1, 2 and 5 times the powers of ten from the first to before the last."""
    return tuple(step * 10.0**power for power in range(first_power, last_power) for step in STEPS)


def nice_step(length: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is no longer than the length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(m for m in STEPS if m * power <= length * (1 + 1e-9)) * power)


NICE = nice_numbers(-3, 6)


def multiples(low: float, high: float, step: float) -> Array:
    """The multiples of a `step` from `low` to `high`, both included."""
    return np.asarray(np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step + 0.0)
