"""Colours (red, green, blue) of the pictures: those of Okabe and Ito, which colour-blind readers can tell apart.

Source: Okabe and Ito (2008), Color Universal Design. One meaning, one colour, in the picture as in the maps.
"""

from __future__ import annotations

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
DIM_INK: Colour = (151, 163, 180)
FAINT_INK: Colour = (74, 86, 104)
GRID: Colour = (44, 53, 68)
DETECTION: Colour = (150, 160, 176)
PAPER: Colour = (13, 17, 25)  # around the picture
SKY_DARK: Colour = (14, 20, 33)
SKY_BRIGHT: Colour = (34, 48, 78)
WALL: Colour = (19, 17, 18)
STARLIGHT: Colour = (255, 253, 248)
PANEL: Colour = (19, 25, 36)
MAP: Colour = (11, 15, 23)
FLOOR: Colour = (27, 36, 51)

STATUS: dict[str, Colour] = {"ok": BLUISH_GREEN, "ambiguous": ORANGE, "refused": VERMILLION}


def mixed(a: Colour, b: Colour, part_of_b: float) -> Colour:
    """Colour between a and b."""
    r, g, blue = (round((1 - part_of_b) * x + part_of_b * y) for x, y in zip(a, b, strict=True))
    return r, g, blue
