"""A picture to draw on: anti-aliased shapes at sub-pixel places (OpenCV), text clear of other text, and colours."""

from __future__ import annotations

import unicodedata
from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont

Colour = tuple[int, int, int]

BLUISH_GREEN: Colour = (0, 158, 115)
ORANGE: Colour = (230, 159, 0)
SKY_BLUE: Colour = (86, 180, 233)
YELLOW: Colour = (240, 228, 66)
VERMILLION: Colour = (213, 94, 0)
REDDISH_PURPLE: Colour = (204, 121, 167)

IDENTIFIED = BLUISH_GREEN
HIDDEN = ORANGE
SKYLINE = SKY_BLUE
BODY = YELLOW
POSITION = VERMILLION
TRUTH = REDDISH_PURPLE

INK: Colour = (236, 240, 245)
MEASURED = INK  # small dots on the line of the skyline
DIM_INK: Colour = (151, 163, 180)
FAINT_INK: Colour = (74, 86, 104)
GRID: Colour = (44, 53, 68)
DETECTION = DIM_INK
PAPER: Colour = (13, 17, 25)  # around the picture
SKY_DARK: Colour = (14, 20, 33)
SKY_BRIGHT: Colour = (34, 48, 78)
WALL: Colour = (19, 17, 18)
STARLIGHT: Colour = (255, 253, 248)
PANEL: Colour = (19, 25, 36)
MAP = PAPER
FLOOR: Colour = (27, 36, 51)

STATUS: dict[str, Colour] = {"ok": BLUISH_GREEN, "ambiguous": ORANGE, "refused": VERMILLION}


def mix_colours(a: Colour, b: Colour, part_of_b: float) -> Colour:
    """Colour between `a` and `b`: `part_of_b` 0 is a, 1 is b."""
    r, g, blue = (round((1 - part_of_b) * x + part_of_b * y) for x, y in zip(a, b, strict=True))
    return r, g, blue


TITLE_PX, TEXT_PX, CAPTION_SIZE = 22.0, 17.0, 16.0  # sizes of writing
SHIFT_BITS = 4  # OpenCV takes sub-pixel places as integers of 1/16 px
EDGE_PX = 0.4  # added by OpenCV's smoothing to the edge of an area
FARTHEST_PX = 30_000.0  # beyond any picture, within OpenCV's range
Box = tuple[float, float, float, float]  # left, top, right, bottom
KNOWN_BEYOND_ASCII = "±°·…"


@dataclass(frozen=True)
class _Text:
    xy: tuple[float, float]
    text: str
    size: float
    colour: Colour
    halo: bool


class Canvas:
    """Pixels (H, W, 3), red, green, blue. Place (0, 0) is the centre of the top-left pixel; texts appear at the end."""

    def __init__(self, width: int, height: int, colour: Colour = PAPER) -> None:
        self.pixels: NDArray[np.uint8] = np.full((height, width, 3), colour, dtype=np.uint8)
        self._origin = np.zeros(2)
        self._texts: list[_Text] = []
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

    def line(self, points: ArrayLike, colour: Colour, width: int = 1, closed: bool = False) -> None:
        """A line of a `colour` and `width` [px] through the `points` (n, 2); `closed` joins the last to the first."""
        cv2.polylines(self.pixels, [self._to_fixed_point(points)], closed, colour, width, cv2.LINE_AA, SHIFT_BITS)

    def dashes(self, points: ArrayLike, colour: Colour, width: int = 1) -> None:
        """Every other stretch of the `line` through evenly spaced points (n, 2), with its `colour` and `width`."""
        places = self._to_fixed_point(points)
        cv2.polylines(
            self.pixels, [places[k : k + 2] for k in range(0, len(places) - 1, 2)], False, colour, width, cv2.LINE_AA,
            SHIFT_BITS,
        )  # fmt: skip

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
        x, y = self._to_fixed_point(centre).tolist()
        reach = round(radius * 2**SHIFT_BITS)
        cv2.circle(self.pixels, (x, y), reach, colour, width, cv2.LINE_AA, SHIFT_BITS)

    def cross(self, centre: ArrayLike, half: float, colour: Colour, width: int = 1) -> None:
        """An x of half size `half` [px], in lines of a `colour` and `width` [px]."""
        for across in ((half, half), (half, -half)):
            self.line(np.asarray(centre, dtype=float) + np.outer((-1.0, 1.0), across), colour, width)

    def plus(self, centre: ArrayLike, half: float, colour: Colour, width: int = 1) -> None:
        """A + of half size `half` [px], in lines of a `colour` and `width` [px]."""
        for across in ((half, 0.0), (0.0, half)):
            self.line(np.asarray(centre, dtype=float) + np.outer((-1.0, 1.0), across), colour, width)

    def rectangle(self, box: Box, colour: Colour, width: int = -1) -> None:
        """A `box` of a `colour`; filled where `width` is negative."""
        left, top, right, bottom = self._to_fixed_point(np.reshape(box, (2, 2))).ravel().tolist()
        cv2.rectangle(self.pixels, (left, top), (right, bottom), colour, width, cv2.LINE_8, SHIFT_BITS)

    def text(
        self, xy: ArrayLike, text: str, size: float, colour: Colour = INK, anchor: str = "ls", halo: bool = False
    ) -> Box:
        """Write `text` of `size` [px] at `xy`, where `label` then writes nothing; returns the box.

        `anchor` is the place of `xy` in the text: l, m or r, and t (top), m or s. `halo` adds a dark edge to
        letters of any `colour`.
        """
        text = printable(text)
        x, y = (float(c) for c in np.asarray(xy, dtype=float))
        width, (rise, fall) = text_width(text, size), _height(size)
        x -= {"l": 0.0, "m": width / 2, "r": width}[anchor[0]]
        y += {"t": rise, "m": (rise - fall) / 2 + 0.06 * size, "s": 0.0}[anchor[1]]
        box = x, y - rise, x + width, y + fall
        self._texts.append(_Text((x, y), text, size, colour, halo))
        self._occupied.append(box)
        return box

    def label(self, at: ArrayLike, text: str, size: float, colour: Colour, gap: float, within: Box) -> bool:
        """Write `text` of `size` [px] and `colour` beside the place `at`, a `gap` [px] off, inside the box `within`.

        It stands at the first of eight sides that is free; False where there is none.
        """
        x, y = (float(c) for c in np.asarray(at, dtype=float))
        width, (rise, fall) = text_width(printable(text), size), _height(size)
        near = 0.75 * gap
        middle = y + (rise - fall) / 2
        sides = [
            (x + gap, middle), (x - gap - width, middle), (x + near, y - near), (x + near, y + near + rise),
            (x - near - width, y - near), (x - near - width, y + near + rise), (x - width / 2, y - gap - fall),
            (x - width / 2, y + gap + rise),
        ]  # fmt: skip
        for left, base in sides:
            box = left - 2, base - rise, left + width + 2, base + fall
            inside = box[0] >= within[0] and box[1] >= within[1] and box[2] <= within[2] and box[3] <= within[3]
            if inside and self.is_free(box):
                self.text((left, base), text, size, colour, halo=True)
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
        for t in self._texts:
            stroke = max(1, round(t.size / 10)) if t.halo else 0
            draw.text(t.xy, t.text, t.colour, _font(t.size), "ls", stroke_width=stroke, stroke_fill=(8, 11, 17))
        return np.asarray(picture)


def box_around(centre: ArrayLike, half: float) -> Box:
    """The box of half size `half` [px] about the place `centre`."""
    x, y = (float(c) for c in np.asarray(centre, dtype=float))
    return x - half, y - half, x + half, y + half


def printable(text: str) -> str:
    """The text in the letters that the font has: accents are dropped, other unknown letters become question marks."""
    letters = unicodedata.normalize("NFKD", text.replace("\N{MINUS SIGN}", "-"))
    return "".join(_ascii_letter(letter) for letter in letters if not unicodedata.combining(letter))


def text_width(text: str, size: float) -> float:
    """Width of a text [px]."""
    return float(_font(size).getlength(text))


def wrap_text(text: str, size: float, width: float) -> list[str]:
    """The words of `text` of `size` [px] in lines no wider than `width` [px], but for a word that alone is wider."""
    lines: list[str] = []
    for word in printable(text).split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and text_width(longer, size) <= width:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


def _ascii_letter(letter: str) -> str:
    if letter.isascii():
        return letter if letter.isprintable() else " "
    return letter if letter in KNOWN_BEYOND_ASCII else "?"


@lru_cache(maxsize=32)
def _font(size: float) -> FreeTypeFont:
    from PIL import ImageFont

    font = ImageFont.load_default(size)
    if not isinstance(font, ImageFont.FreeTypeFont):
        raise RuntimeError("Pillow was built without FreeType: its default font cannot be scaled")
    return font


def _height(size: float) -> tuple[float, float]:
    """Rise above and fall below the line of writing [px]."""
    return 0.74 * size, 0.22 * size


def png_bytes(picture: NDArray[np.uint8]) -> bytes:
    """A `picture` (H, W, 3), red, green, blue, as the content of a PNG file."""
    # Run lengths are smaller and quicker for flat colours.
    return encoded_bytes(".png", picture[:, :, ::-1], cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)


def encoded_bytes(suffix: str, pixels: NDArray[np.uint8], *flags: int) -> bytes:
    """Pixels (H, W, 3 or 4), blue first, as the content of a file with a `suffix`; `flags` are OpenCV's."""
    ok, data = cv2.imencode(suffix, pixels, flags)
    if not ok:
        raise RuntimeError(f"OpenCV could not encode a picture as {suffix}")
    return data.tobytes()
