"""Errors of one method by sky, collected from the chunks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from startrack.applications.reproduction.artefact import Context
from startrack.applications.reproduction.methods import Chunk, Task
from startrack.core.types import Array, Bools

ERROR_OF = {"kua": ("hull_m", "refined_m"), "ours": ("fix_m",), "bound": ("centroid_m",)}
ANSWERED = {"kua": "settled", "ours": "located", "bound": None}


@dataclass(frozen=True)
class MethodErrors:
    """Errors of one estimate."""

    positions_m: tuple[Array, ...]  # by sky: (n, 2) [m], where there is an estimate
    errors_m: tuple[Array, ...]  # by sky: (n,) [m]
    answered: tuple[Bools, ...]  # by sky: settled (kua) or located (ours), for every position
    ms_per_fix: float

    @property
    def errors(self) -> Array:
        """Errors of all skies (n,) [m]."""
        return np.concatenate(self.errors_m)

    @property
    def refused_count(self) -> int:
        """Positions without an estimate; for the pseudo-gradient, with one that never settled."""
        return int(sum((~one).sum() for one in self.answered))

    @property
    def refused_fraction(self) -> float:
        return self.refused_count / max(sum(map(len, self.answered)), 1)


def collect_errors(context: Context, what: str, by_sky: Sequence[Sequence[Task]]) -> list[MethodErrors]:
    """Errors of every estimate of the tasks' method (all of one method), in the order of `ERROR_OF`."""
    wanted = [task for one in by_sky for task in one]
    chunks: list[list[Chunk]] = [[] for _ in by_sky]
    sky_of = [number for number, one in enumerate(by_sky) for _ in one]
    for number, chunk in zip(sky_of, context.store.chunks(what, wanted), strict=True):
        chunks[number].append(chunk)
    method = wanted[0].method
    ms = 1e3 * sum(float(chunk["seconds"][0]) for one in chunks for chunk in one) / sum(map(len, wanted))
    flag = ANSWERED[method]
    flags = tuple(np.concatenate([chunk[flag] for chunk in one]) for one in chunks) if flag else ()
    found = []
    for key in ERROR_OF[method]:
        pairs = [[_positions_and_errors(chunk, key) for chunk in one] for one in chunks]
        positions = tuple(np.concatenate([position for position, _ in one]) for one in pairs)
        errors = tuple(np.concatenate([error for _, error in one]) for one in pairs)
        found.append(MethodErrors(positions, errors, flags, ms))
    return found


def _positions_and_errors(chunk: Chunk, key: str) -> tuple[Array, Array]:
    truth = chunk["truth_m"][chunk["located"]] if "located" in chunk else chunk["truth_m"]
    return truth, np.hypot(*(chunk[key] - truth).T)


def statistics(errors_m: Array) -> dict[str, float]:
    """Mean, standard deviation and largest of the errors [m], and their number."""
    return {
        "mean_m": float(errors_m.mean()),
        "sd_m": float(errors_m.std()),
        "max_m": float(errors_m.max()),
        "count": len(errors_m),
    }


def format_errors(errors_m: Array, form: str = "{:.1f} / {:.1f} / {:.1f}") -> str:
    """Mean / standard deviation / largest."""
    return form.format(errors_m.mean(), errors_m.std(), errors_m.max())
