"""What a quantity of the result record is: its path, unit and value, and the places where it is shown."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from startrack.chain import Inputs
from startrack.output.schema_parts import Schema

ABSENT: Any = object()  # of a quantity that has no key before its stage


@dataclass(frozen=True)
class Show:
    """One place where a quantity is shown; the quantities of one row are joined.

    `place` is summary, text, panel, notebook or page; `row` names the line of text or the row of a table; `form` makes
    the text, by str.format or as a function. Nothing is shown where the quantity at the path `unless` is known.
    """

    place: str
    row: str
    form: str | Callable[[Any], str]
    unless: str = ""


@dataclass(frozen=True)
class Column:
    """A column of the batch's table: its name, its printf format, and which element of the value it holds."""

    name: str
    form: str
    at: tuple[int, ...] = ()


@dataclass(frozen=True)
class Listed:
    """A column in the page's list of images: heading, decimals, and whether narrow screens have it too."""

    heading: str
    decimals: int
    always: bool = False


@dataclass(frozen=True)
class Quantity:
    """One quantity of the result record, or one that is only shown."""

    path: str  # KEY or SECTION.KEY of the record
    unit: str  # as docs/formats.md spells it; empty for texts and pure numbers
    since: type[Inputs]  # the first value of the pipeline that determines it
    value: Callable[[Any], Any]  # of such a value; where `derived`, of the function from paths to values
    description: str
    schema: Schema = field(default_factory=dict)
    before: Any = ABSENT  # in the record of a value that has not come as far: ABSENT, None, a number, or a function
    nullable: bool = False  # whether it may be null of a value that has come as far
    optional: bool = False  # whether records of earlier stages or versions lack it although they have its section
    columns: tuple[Column, ...] = ()
    shown: tuple[Show, ...] = ()
    listed: Listed | None = None
    derived: bool = False  # made from other quantities, and not in the record
    recorded: bool = True

    @property
    def section(self) -> str:
        """The part of the record that holds it; empty for a key of the record itself."""
        return self.path.rpartition(".")[0]

    @property
    def key(self) -> str:
        """Its key in the section."""
        return self.path.rpartition(".")[2]


def show_everywhere(label: str, form: str, line: str) -> tuple[Show, ...]:
    """A quantity shown as `label` with its `form` in text (on the `line`), panel, notebook and page."""
    where = (("text", line), ("panel", label), ("notebook", label.lower()), ("page", label))
    return tuple(Show(place, row, f"; {label.lower()} {form}" if place == "text" else form) for place, row in where)
