"""Run of an exposure through the stages: the last complete value, the times of the stages, and the refusal."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import MappingProxyType
from typing import TypeVar

from startrack.chain.stages import Inputs, Outcome, Refused
from startrack.core.errors import Reason
from startrack.core.limits import check_time, stating_work
from startrack.core.types import BadInput, NoSolution

HIDDEN_BY_DAMAGE = {  # reasons that damage of the image causes too
    Reason.NOT_IDENTIFIED, Reason.INCONSISTENT_EVIDENCE, Reason.INSUFFICIENT_GEOMETRY, Reason.DAMAGED_IMAGE,
}  # fmt: skip
T = TypeVar("T", bound=Inputs)
AnyOutcome = TypeVar("AnyOutcome", bound=Outcome)


class Run:
    """The last complete value that a run from the `inputs` on has reached, and the wall times of its stages."""

    def __init__(self, inputs: Inputs) -> None:
        self._reached = inputs
        self._times = dict[str, float]()

    def reach(self, value: T) -> T:
        """The `value` itself, which is from now on the last complete one."""
        self._reached = value
        return value

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Context whose time counts as that of the stage `name`."""
        start = time.perf_counter()
        try:
            with stating_work(lambda: f"it was at the stage {name}"):
                check_time()
                yield
        finally:
            self._times[name] = self._times.get(name, 0.0) + 1e3 * (time.perf_counter() - start)

    def finish(self, value: T) -> T:
        """Copy of the run's result, its last `value`, with the times of the stages."""
        return replace(value, timing_ms=MappingProxyType(self._times))

    def refuse(self, cause: BadInput | NoSolution) -> Refused:
        """The refusal that the `cause` makes of the run, with the last complete value that was reached.

        Where damage of the image may be behind the cause, that is the reason.
        """
        damage = self._reached.damage if cause.reason in HIDDEN_BY_DAMAGE else None  # of which it may be the result
        return Refused(
            reason=cause.reason if damage is None else Reason.DAMAGED_IMAGE,
            message=str(cause) if damage is None else f"{damage.message} ({cause})",
            reached=self._reached,
            timing_ms=MappingProxyType(self._times),
        )


def add_timing(outcome: AnyOutcome, **more_ms: float) -> AnyOutcome:
    """Copy of an `outcome` with `more_ms`, wall times [ms] by stage, added to its stages' times."""
    times = dict(outcome.timing_ms)
    for stage, ms in more_ms.items():
        times[stage] = times.get(stage, 0.0) + ms
    return replace(outcome, timing_ms=MappingProxyType(times))
