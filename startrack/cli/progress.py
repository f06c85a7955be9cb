"""The progress bar of every command that lasts: on a terminal only."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress
    from rich.progress import TaskID


class Progress:
    """Progress of a command without output."""

    def advance(self, steps: int = 1, text: str | None = None) -> None:
        """Further steps are done; `text` names the current step."""

    def update(self, completed: int, total: int) -> None:
        """Numbers of steps done and of all steps."""


class _Bar(Progress):
    """One row of a bar of rich."""

    def __init__(self, bar: RichProgress, row: TaskID) -> None:
        self._bar, self._row = bar, row

    def advance(self, steps: int = 1, text: str | None = None) -> None:
        self._bar.advance(self._row, steps)
        if text is not None:
            self._bar.update(self._row, text=text)

    def update(self, completed: int, total: int) -> None:
        self._bar.update(self._row, completed=completed, total=total)


@contextmanager
def progress(what: str, total: int | None = None, *, shown: bool = True) -> Iterator[Progress]:
    """A bar on stderr with a text behind it, if `shown` and stderr is a terminal; it disappears at the end."""
    if not shown or total == 0 or not sys.stderr.isatty():
        yield Progress()
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as RichProgress

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with RichProgress(*columns, TextColumn("{task.fields[text]}"), console=Console(stderr=True), transient=True) as bar:
        yield _Bar(bar, bar.add_task(what, total=total, text=""))
