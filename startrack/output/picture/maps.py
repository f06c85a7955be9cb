"""Maps: the search area with the position, the position with its error, the relief of a terrain lit as maps are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from startrack.core.errors import length_text
from startrack.core.types import Array, Bools, Fix
from startrack.output.picture.canvas import (
    GAP_PX,
    NICE,
    TEXT_PX,
    Box,
    Canvas,
    Colour,
    Ink,
    box_around,
    mix_colours,
    multiples,
    nice_step,
)
from startrack.terrain import Terrain

Image = NDArray[np.float32]
CIRCLE_RAD = np.linspace(0.0, 2 * np.pi, 181)
SIDE_PX, MARGIN_PX, BELOW_PX = 860.0, 4 * TEXT_PX, 3 * TEXT_PX  # of a picture of one map, and beside it, for its scales
LEAST_CONTOUR_PX = 4 * TEXT_PX  # a shorter one is noise
SEARCH_MARGIN = 1.07  # of a map, in radii of the search area
RELIEF_LIGHT = 3.0  # slopes that face the light, as a multiple of the floor's colour
MAX_LEVELS = 12
GENTLE_SLOPE = 0.02  # gentler ground looks flat


@dataclass(frozen=True)
class Map:
    """A map on a canvas: points of enu with north up, `metres_per_px` from the point in the middle of its box."""

    canvas: Canvas
    box: Box
    centre_m: tuple[float, float]
    metres_per_px: float

    @classmethod
    def of_extent(cls, canvas: Canvas, box: Box, centre_m: tuple[float, float], half_m: float) -> Map:
        """A map in the `box` of the `canvas` that shows `half_m` in every direction from `centre_m`, east and north."""
        left, top, right, bottom = box
        return cls(canvas, box, centre_m, 2 * half_m / min(right - left, bottom - top))

    @cached_property
    def window(self) -> Canvas:
        """The canvas, with shapes clipped to the box."""
        return self.canvas.window(self.box)

    def canvas_px(self, points_m: ArrayLike) -> Array:
        """Canvas pixels (..., 2) of `points_m` (..., 2), east and north."""
        offset = (np.asarray(points_m, dtype=float) - self.centre_m) / self.metres_per_px
        return self.middle + offset * [1.0, -1.0]

    @property
    def middle(self) -> Array:
        """The place (2,) in the middle of the box."""
        return 0.5 * (np.array(self.box[:2]) + self.box[2:])

    @property
    def half_m(self) -> Array:
        """Half of the shown extent, east and north [m]."""
        return 0.5 * np.subtract(self.box[2:], self.box[:2]) * self.metres_per_px

    def ground(self, terrain: Terrain) -> tuple[Image, Bools]:
        """Heights [m] of a `terrain` at every second pixel of the map, and where there is ground."""
        width, height = self.window.size
        return ground_cells(terrain, self.half_m, (max(2, height // 2), max(2, width // 2)), self.centre_m)

    def draw_ground(self, terrain: Terrain) -> None:
        """The shape of the ground of a `terrain`, or the rim of a cylinder; the search area (dashed) and a grid."""
        rim, origin = terrain.rim.radius_m if terrain.rim else 0.0, self.canvas_px((0.0, 0.0))
        self.window.rectangle(self.box, Ink.PAPER)
        if not rim:
            self.draw_relief(*self.ground(terrain))
        elif float(np.linalg.norm(np.abs(self.centre_m) + self.half_m)) < rim:  # the map ends within it
            self.window.rectangle(self.box, Ink.FLOOR)
        else:
            self.window.circle(origin, rim / self.metres_per_px, Ink.FLOOR, -1)
        self.draw_grid()
        if rim:
            self.window.circle(origin, rim / self.metres_per_px, Ink.DIM, 2)
        if abs(terrain.search_radius_m - rim) > 0.01 * rim:
            self.window.line(self.canvas_px(ring((0.0, 0.0), terrain.search_radius_m)), Ink.DIM, dashed=True)

    def draw_relief(self, ground_m: Image, known: Bools) -> None:
        """The relief of heights `ground_m` (n, n) [m] where they are `known` (n, n), elsewhere the map's colour."""
        size = self.window.size
        lit = (enlarge_image(hill_shading(ground_m, known, self.half_m), size) * edge_cover(known, size))[:, :, None]
        paper = np.array(Ink.PAPER)
        self.window.pixels[:] = (paper + lit * (RELIEF_LIGHT * np.array(Ink.FLOOR) - paper)).astype(np.uint8)

    def draw_heights(self, terrain: Terrain) -> str:
        """Contours of a `terrain` with their heights; words about them, empty of flat ground and of a cylinder."""
        if terrain.rim is not None:
            return ""
        ground_m, known = self.ground(terrain)
        heights_m = ground_m[inner_cells(known)]
        low, high = float(heights_m.min(initial=np.inf)), float(heights_m.max(initial=-np.inf))
        if high - low < 1.0:
            return ""
        step_m = next(one for one in NICE if one * MAX_LEVELS >= high - low)
        fine = enlarge_image(extrapolate_values(ground_m, known), self.window.size)
        inside = edge_cover(inner_cells(known), self.window.size) > 0.5
        levels = {level: f"{level:g}" for level in multiples(low, high, step_m) if low < level < high}
        self.draw_contours(fine, levels, inside, mix_colours(Ink.FLOOR, Ink.DIM, 0.7))
        return f"contours each {step_m:g} m, heights above the sphere at the origin"

    def draw_contours(
        self, values: NDArray[Any], levels: dict[float, str], inside: Bools, colour: Colour, width: int = 1
    ) -> None:
        """Contours of `values` (H, W) at the `levels`, with their texts, where the mask `inside` (H, W) has them.

        `colour` and `width` are those of the lines. A long contour has its text twice, where there is room.
        """
        from skimage.measure import find_contours

        extent = np.subtract(self.box[2:], self.box[:2])
        for level, text in levels.items():
            half_px = 0.36 * TEXT_PX * len(text) + GAP_PX
            for row_column in find_contours(values, level, mask=inside):
                line = row_column[:, ::-1] + self.box[:2]
                length_px = float(np.hypot(*np.diff(line, axis=0).T).sum())
                if length_px < LEAST_CONTOUR_PX:
                    continue  # a speck
                self.window.line(line, colour, width)
                at = line[:: int(GAP_PX)]
                at = at[(np.abs(at - self.middle) < extent / 2 - half_px - GAP_PX).all(axis=1)]
                for _ in range(min(2, int(length_px / (6 * TEXT_PX)))):
                    free = [place for place in at if self.canvas.is_free(box_around(place, half_px))]
                    if not free:
                        break
                    # North-east of the middle first, then as far from there as the contour goes.
                    x, y = free[int(np.argmax([place[0] - place[1] for place in free]))]
                    self.canvas.text((x, y), text, Ink.PLAIN, "mm", halo=True)
                    at = at[np.hypot(*(at - (x, y)).T) > 0.4 * extent[0]]

    def grid(self, axis: int) -> tuple[Array, Array]:
        """Coordinates [m] and places [px] of the grid's lines, east (axis 0) or north (1)."""
        middle, half = self.centre_m[axis], self.half_m[axis]
        lines_m = multiples(middle - half, middle + half, nice_step(0.7 * float(self.half_m.min())))
        return lines_m, self.canvas_px(np.stack([lines_m, lines_m], axis=-1))[:, axis]

    def draw_grid(self) -> None:
        """Lines of even distances from the origin."""
        left, top, right, bottom = self.box
        for x in self.grid(0)[1]:
            self.window.line([(x, top), (x, bottom)], Ink.GRID)
        for y in self.grid(1)[1]:
            self.window.line([(left, y), (right, y)], Ink.GRID)

    def draw_frame(self, caption: str) -> None:
        """Frame, `caption` and scale bar of the map."""
        left, top, right, bottom = self.box
        self.canvas.rectangle(self.box, Ink.FAINT, 1)
        self.canvas.text((left + GAP_PX, top + GAP_PX), caption, anchor="lt", halo=True)
        length_m = nice_step(0.6 * float(self.half_m[0]))
        x1, y1 = right - TEXT_PX, bottom - TEXT_PX
        x0, y0 = x1 - length_m / self.metres_per_px, y1 - GAP_PX
        self.canvas.line([(x0, y0), (x0, y1), (x1, y1), (x1, y0)], Ink.PLAIN, 2)
        self.canvas.text(((x0 + x1) / 2, y0), distance_text(length_m), Ink.PLAIN, "ms", halo=True)

    def draw_distances(self) -> None:
        """East and north of the lines of the grid, outside of the map."""
        left, _, right, bottom = self.box
        unit, metres = ("km", 1000.0) if float(self.half_m.min()) >= 2000.0 else ("m", 1.0)
        for east_m, x in zip(*self.grid(0), strict=True):
            self.canvas.text((x, bottom + GAP_PX), f"{east_m / metres:g}", anchor="mt")
        for north_m, y in zip(*self.grid(1), strict=True):
            self.canvas.text((left - GAP_PX, y), f"{north_m / metres:g}", anchor="rm")
        words = f"east and north of the origin [{unit}]"
        self.canvas.text(((left + right) / 2, bottom + 2 * TEXT_PX), words, anchor="mt")


def draw_overview(
    canvas: Canvas, box: Box, terrain: Terrain, fix: Fix | None = None, truth: ArrayLike | None = None
) -> Map:
    """Draw the search area of a `terrain`, and the positions of a `fix`, in the `box` of the `canvas`.

    All positions of the fix are drawn if it is ambiguous. `truth` (2,) is the true one, east and north [m].
    """
    reach = max(min(terrain.search_radius_m, terrain.reach_m), terrain.rim.radius_m if terrain.rim else 0.0)
    drawn = Map.of_extent(canvas, box, (0.0, 0.0), SEARCH_MARGIN * reach)
    drawn.draw_ground(terrain)
    if truth is not None:
        drawn.window.mark(drawn.canvas_px(truth), "plus", GAP_PX, Ink.TRUTH)
    for k, mode in enumerate(() if fix is None else fix.modes if fix.ambiguous else fix.modes[:1]):
        place, radius_px = drawn.canvas_px((mode.east_m, mode.north_m)), mode.radius95_m / drawn.metres_per_px
        drawn.window.mark(place, "place", GAP_PX, Ink.POSITION)
        if fix is not None and fix.ambiguous:
            drawn.window.circle(place, radius_px if GAP_PX < radius_px < np.inf else 0.0, Ink.POSITION, 2)
            canvas.label(place, f"{k + 1}: {100 * mode.weight:.0f} %", Ink.PLAIN, TEXT_PX, box)
    drawn.draw_frame("search area, north up")
    return drawn


def draw_zoom(canvas: Canvas, box: Box, fix: Fix, truth: ArrayLike | None) -> Map:
    """The position with its covariance ellipse (one sigma, filled) and the circle that holds 95 % of the posterior."""
    position = (float(fix.position_enu_m[0]), float(fix.position_enu_m[1]))
    half = 1.3 * fix.radius95_m
    if truth is not None:  # as far out as that is still a zoom
        half = max(half, min(1.3 * float(np.linalg.norm(np.subtract(truth, position))), 4 * half))
    drawn = Map.of_extent(canvas, box, position, half)
    window = drawn.window
    window.rectangle(box, Ink.PAPER)
    drawn.draw_grid()
    ellipse = drawn.canvas_px(ellipse_m(position, fix.covariance_m2))
    window.area(ellipse, mix_colours(Ink.PAPER, Ink.POSITION, 0.35))
    window.line(ellipse, mix_colours(Ink.PAPER, Ink.POSITION, 0.8))
    window.circle(drawn.middle, fix.radius95_m / drawn.metres_per_px, Ink.POSITION, 2)
    window.mark(drawn.middle, "plus", GAP_PX, Ink.PLAIN)
    if truth is not None and bool(np.all(np.abs(np.subtract(truth, position)) < drawn.half_m)):
        window.mark(drawn.canvas_px(truth), "plus", GAP_PX, Ink.TRUTH)
        canvas.label(drawn.canvas_px(truth), "truth", Ink.TRUTH, TEXT_PX, box)
    drawn.draw_frame(f"95 % within {length_text(fix.radius95_m, 3)}")
    return drawn


def relief_picture(terrain: Terrain, position_m: tuple[float, float] | None = None) -> NDArray[np.uint8]:
    """The relief (H, W, 3) of a `terrain`, lit from the north-west, with contours and the search area (dashed).

    `position_m`, east and north, is marked if it is given.
    """
    box = (MARGIN_PX, GAP_PX, MARGIN_PX + SIDE_PX, GAP_PX + SIDE_PX)
    canvas = Canvas(round(box[2] + GAP_PX), round(box[3] + BELOW_PX))
    drawn = draw_overview(canvas, box, terrain)
    canvas.text((box[2] - GAP_PX, box[1] + GAP_PX), terrain.name, Ink.PLAIN, "rt", halo=True)
    if position_m is not None:
        canvas.mark(drawn.canvas_px(position_m), "place", GAP_PX, Ink.POSITION)
        canvas.reserve(box_around(drawn.canvas_px(position_m), TEXT_PX))
    drawn.draw_distances()
    words = drawn.draw_heights(terrain)
    canvas.text((box[0] + GAP_PX, box[3] - GAP_PX), words, halo=True)
    return canvas.rendered_pixels()


def distance_text(metres: float) -> str:
    """A scale bar's length of `metres` in words."""
    return f"{metres / 1000:g} km" if metres >= 1000 else f"{metres:g} m" if metres >= 0.1 else f"{100 * metres:g} cm"


def ring(centre_m: tuple[float, float], radius_m: float) -> Array:
    """Points (n, 2) of a circle."""
    return np.asarray(centre_m) + radius_m * np.stack([np.sin(CIRCLE_RAD), np.cos(CIRCLE_RAD)], axis=-1)


def ellipse_m(centre_m: tuple[float, float], covariance_m2: Array) -> Array:
    """Points (n, 2) [m] of the ellipse of one sigma of `covariance_m2` (2, 2) about `centre_m`."""
    lengths, axes = np.linalg.eigh(covariance_m2)
    half_m = np.sqrt(np.maximum(lengths, 0.0))
    return np.asarray(centre_m) + (ring((0.0, 0.0), 1.0) * half_m) @ axes.T


def ground_cells(
    terrain: Terrain, half_m: ArrayLike, shape: tuple[int, int], centre_m: tuple[float, float] = (0.0, 0.0)
) -> tuple[Image, Bools]:
    """Heights [m] (H, W) within `half_m` east and north of the centre, north up, and where there is ground."""
    points_m = cell_points(half_m, shape) + np.asarray(centre_m)
    known = np.asarray(terrain.allowed(points_m.reshape(-1, 2)), dtype=bool).reshape(shape)
    ground_m = np.zeros(shape, dtype=np.float32)
    ground_m[known] = terrain.ground_m(points_m[known])
    return ground_m, known


def cell_points(half_m: ArrayLike, shape: tuple[int, int]) -> Array:
    """Points (H, W, 2), east and north [m] of a map's centre, of its cells of `shape` (H, W), north up."""
    x, y = (np.linspace(-half, half, n) for half, n in zip(np.asarray(half_m), shape[::-1], strict=True))
    return np.stack(np.meshgrid(x, y[::-1]), axis=-1)


def hill_shading(ground_m: Image, known: Bools, half_m: ArrayLike) -> Image:
    """Light (H, W), 0 to 1, on cells lit from the north-west as maps are; carried some cells beyond the ground."""
    east_m, north_m = (2 * half / (n - 1) for half, n in zip(np.asarray(half_m), known.shape[::-1], strict=True))
    down, east = np.gradient(ground_m)
    facing, inner = east / east_m + down / north_m, inner_cells(known)
    steep = max(float(np.percentile(np.abs(facing[inner]), 95)) if inner.any() else 0.0, GENTLE_SLOPE)
    light = np.maximum(0.5 + 0.5 * np.tanh(1.2 * facing / steep), 0.05)
    return extrapolate_values(light.astype(np.float32), inner)


def edge_cover(known: Bools, size: tuple[int, int]) -> Array:
    """1 on known ground and 0 beside it, (H, W) of the given size (W, H), with a smooth edge."""
    soft = enlarge_image(np.asarray(cv2.GaussianBlur(known.astype(np.float32), (0, 0), 1.5)), size)
    return np.clip((soft - 0.5) * 4 + 0.5, 0, 1).astype(np.float64)


def inner_cells(known: Bools) -> Bools:
    """The mask without the cells at its edge, whose slopes would be those of a cliff that does not exist."""
    return cv2.erode(known.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE) > 0


def extrapolate_values(values: Image, known: Bools) -> Image:
    """Known values, carried a few cells beyond their edge."""
    filled, weight = np.where(known, values, 0).astype(np.float32), known.astype(np.float32)
    for reach in (3, 7, 15):
        near = cv2.blur(weight, (reach, reach))
        carried = cv2.blur(filled, (reach, reach)) / np.maximum(near, 1e-6)
        new = (weight == 0) & (near > 1e-6)
        filled[new], weight[new] = carried[new], 1.0
    return filled


def enlarge_image(image: Image, size: tuple[int, int]) -> Image:
    """The image, smooth, in a `size` (W, H)."""
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), dtype=np.float32)
