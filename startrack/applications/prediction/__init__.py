"""Prediction of accuracy: draws of evidence at places, located by the same search as images."""

from startrack.applications.prediction.draws import Conditions, Place, Predictor, Status, draw_store, times_between
from startrack.applications.prediction.places import area_cells, default_spacing_m, path_points
from startrack.applications.prediction.quantities import CELL_QUANTITIES, PATH_QUANTITIES, PREDICTION, summarize_cells
from startrack.applications.prediction.report import Plan, Report, write_report
from startrack.applications.prediction.run import (
    Prediction,
    Predictions,
    cells_of_draws,
    predict_positions,
    share_within,
)

__all__ = [
    "CELL_QUANTITIES", "PATH_QUANTITIES", "PREDICTION", "Conditions", "Place", "Plan", "Prediction",
    "Predictions", "Predictor", "Report", "Status", "area_cells", "cells_of_draws", "default_spacing_m", "draw_store",
    "path_points", "predict_positions", "share_within", "summarize_cells", "times_between", "write_report",
]  # fmt: skip
