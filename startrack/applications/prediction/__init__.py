"""Prediction of accuracy: draws of evidence at places, located by the same search as images."""

from startrack.applications.prediction.draws import (
    Conditions,
    Place,
    Predictor,
    Status,
    draw_store,
    evenly_spaced,
)
from startrack.applications.prediction.places import area_cells, default_spacing_m, path_points
from startrack.applications.prediction.quantities import CELL_QUANTITIES, PATH_QUANTITIES, PREDICTION, summarized
from startrack.applications.prediction.report import OdometryErrors, Report
from startrack.applications.prediction.run import Prediction, Predictions, predict_positions
from startrack.applications.prediction.statistics import predicted, share_within
from startrack.applications.prediction.write import write_report

__all__ = [
    "CELL_QUANTITIES", "PATH_QUANTITIES", "PREDICTION", "Conditions", "OdometryErrors", "Place", "Prediction",
    "Predictions", "Predictor", "Report", "Status", "area_cells", "default_spacing_m", "draw_store", "evenly_spaced",
    "path_points", "predict_positions", "predicted", "share_within", "summarized", "write_report",
]  # fmt: skip
