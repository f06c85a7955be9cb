"""What the search reads of its settings."""

from __future__ import annotations

from typing import Protocol


class SearchSettings(Protocol):
    """What the search reads of `ExactPosterior`."""

    @property
    def prune_nats(self) -> float: ...
    @property
    def negligible_nats(self) -> float: ...
    @property
    def finest_m(self) -> float: ...
    @property
    def boxes_per_sigma(self) -> float: ...
    @property
    def most_boxes(self) -> int: ...
    @property
    def budget_horizons(self) -> float: ...
