"""Prediction of accuracy: draws of evidence at places, located by the same search as images."""

from startrack.applications.prediction.draws import (
    AMBIGUOUS,
    OK,
    REFUSED,
    Conditions,
    Place,
    Predictor,
    Task,
    evenly_spaced,
    joined,
)
from startrack.applications.prediction.places import AreaCells, PathPoints, area_cells, default_spacing_m, path_points
from startrack.applications.prediction.run import Prediction, Predictions, predict_positions
from startrack.applications.prediction.statistics import Cells, predicted, share_within, summarized
from startrack.applications.prediction.store import draw_store

__all__ = [
    "AMBIGUOUS",
    "OK",
    "REFUSED",
    "AreaCells",
    "Cells",
    "Conditions",
    "PathPoints",
    "Place",
    "Prediction",
    "Predictions",
    "Predictor",
    "Task",
    "area_cells",
    "default_spacing_m",
    "draw_store",
    "evenly_spaced",
    "joined",
    "path_points",
    "predict_positions",
    "predicted",
    "share_within",
    "summarized",
]
