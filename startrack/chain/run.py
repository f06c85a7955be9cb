"""One exposure on its way through the stages: what was reached, how long each stage took, and the refusal."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import replace
from types import MappingProxyType
from typing import Any, TypeVar

from startrack.chain.stages import Inputs, Refused
from startrack.core.errors import Reason
from startrack.core.types import BadInput, NoSolution

HIDDEN_BY_DAMAGE = {  # reasons that damage of the image causes too
    Reason.NOT_IDENTIFIED, Reason.INCONSISTENT_EVIDENCE, Reason.INSUFFICIENT_GEOMETRY, Reason.DAMAGED_IMAGE,
}  # fmt: skip
T = TypeVar("T", bound=Inputs)
R = TypeVar("R")


def with_timing(outcome: Any, **more_ms: float) -> Any:
    """The same outcome with wall times [ms] added to its stages' times."""
    times = dict(outcome.timing_ms)
    for stage, ms in more_ms.items():
        times[stage] = times.get(stage, 0.0) + ms
    return replace(outcome, timing_ms=MappingProxyType(times))


class Run:
    """One exposure on its way through the stages: the last complete value, and the wall time of each stage."""

    def __init__(self, inputs: Inputs) -> None:
        self.reached = inputs
        self._timing_ms: dict[str, float] = {}

    def time_stage(self, stage: str, function: Callable[..., R], *args: Any) -> R:
        """The result of `function(*args)`, its time added to that of the `stage`."""
        start = clock.perf_counter()
        try:
            return function(*args)
        finally:
            self._timing_ms[stage] = self._timing_ms.get(stage, 0.0) + 1e3 * (clock.perf_counter() - start)

    def run_stage(self, stage: str, function: Callable[..., T], *args: Any) -> T:
        """The same as `time_stage`, for a function that returns the next complete value."""
        value = self.time_stage(stage, function, *args)
        self.reached = value
        return value

    def finish(self, value: T) -> T:
        """The `value` with the times of the stages."""
        return replace(value, timing_ms=MappingProxyType(self._timing_ms))

    def refuse(self, cause: BadInput | NoSolution) -> Refused:
        """The refusal for a `cause`, with the last complete value; of a damaged image its damage may be the reason."""
        damage = self.reached.damage
        damaged = damage is not None and cause.reason in HIDDEN_BY_DAMAGE
        return Refused(
            reason=Reason.DAMAGED_IMAGE if damaged else cause.reason,
            message=str(cause) if damage is None or not damaged else f"{damage.message} ({cause})",
            reached=self.reached,
            timing_ms=MappingProxyType(self._timing_ms),
        )
