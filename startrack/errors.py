"""What can go wrong. Kept apart from the values so that the commands start without numpy."""

from __future__ import annotations

from typing import Any

INTERNAL_ERROR = "internal_error"  # the reason of an image that met a fault of the program's own
BAD_INPUT_REASONS = frozenset(  # exit code 4, and BadInput from the library
    {"bad_image", "size_mismatch", "no_time", "no_calibration", "bad_calibration", "bad_terrain"}
)


class BadInput(Exception):
    """Input that cannot be used (exit code 4). `reason` is one of the codes of the result format."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class NoSolution(Exception):
    """A stage found no answer it can stand by (exit code 3). The message says what to try."""

    reason = "inconsistent_evidence"

    def __init__(self, message: str, reason: str | None = None, **evidence: Any) -> None:
        super().__init__(message)
        if reason is not None:
            self.reason = reason
        self.evidence = evidence


class TooFewStars(NoSolution):
    reason = "no_stars"


class NotIdentified(NoSolution):
    reason = "not_identified"


class NotLocated(NoSolution):
    reason = "insufficient_geometry"
