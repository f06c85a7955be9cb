"""The detectors of the benchmark under one signature: image, PSF sigma to centroids (n, 2), 0-based pixel centres."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from startrack.camera import Camera, Sensor
from startrack.core.types import Exposure, TooFewStars
from startrack.detection import Detector

Finder = Callable[[np.ndarray, float], np.ndarray]
NO_STARS = np.zeros((0, 2))


def startrack(image: np.ndarray, sigma_px: float) -> np.ndarray:
    """Ours, with a camera file with gain and PSF."""
    height, width = image.shape
    sensor = Sensor(zero_point_e_per_s=1e5, psf_sigma_px=sigma_px)
    camera = Camera(
        name="plain", size_px=(width, height), focal_px=(600.0, 600.0), centre_px=(width / 2, height / 2),
        max_angle_rad=1.6, calibrated_angle_rad=1.6, sensor=sensor,
    )  # fmt: skip
    return _detect_ours(image, camera)


def startrack_blind(image: np.ndarray, sigma_px: float) -> np.ndarray:
    """Ours without a camera file: gain unknown, PSF measured from the image."""
    del sigma_px
    return _detect_ours(image, None)


def _detect_ours(image: np.ndarray, camera: Camera | None) -> np.ndarray:
    try:
        return np.asarray(Detector()(Exposure(pixels_adu=image, saturation_adu=65535.0), camera).xy_px)
    except TooFewStars:
        return NO_STARS


def sep_winpos(image: np.ndarray, sigma_px: float) -> np.ndarray:
    """sep: background, extraction at 2 sigma per pixel (its own filter), windowed centroids."""
    import sep

    data = image.copy()
    background = sep.Background(data)
    data -= background.back()
    found = sep.extract(data, 2.0, err=background.globalrms)
    window, _ = sep.flux_radius(data, found["x"], found["y"], 6 * found["a"], 0.5, normflux=found["flux"], subpix=5)
    x, y, _ = sep.winpos(data, found["x"], found["y"], 2 / 2.35 * window)
    return np.stack([x, y], axis=1)


def dao_star_finder(image: np.ndarray, sigma_px: float) -> np.ndarray:
    """photutils DAOStarFinder at 5 sigma of the pixels, the PSF's width given."""
    from photutils.detection import DAOStarFinder

    level = float(np.median(image[::4, ::4]))
    noise = 1.4826 * float(np.median(np.abs(image[::4, ::4] - level)))
    found = DAOStarFinder(threshold=5.0 * noise, fwhm=2.355 * sigma_px)(image - level)
    if found is None:
        return NO_STARS
    x, y = ("x_centroid", "y_centroid") if "x_centroid" in found.colnames else ("xcentroid", "ycentroid")
    return np.stack([np.asarray(found[x]), np.asarray(found[y])], axis=1)


def tetra3rs_centroids(image: np.ndarray, sigma_px: float) -> np.ndarray:
    """tetra3rs extract_centroids_fast with its defaults."""
    import tetra3rs

    found = tetra3rs.extract_centroids_fast(np.ascontiguousarray(image), threads=1).centroids
    height, width = image.shape
    centre = np.array([(width - 1) / 2, (height - 1) / 2])  # its pixels count from the image's centre
    return np.array([[c.x, c.y] for c in found]).reshape(-1, 2) + centre


def blurred_components(image: np.ndarray, sigma_px: float) -> np.ndarray:
    """OpenCV: blur by the PSF, threshold at 5 sigma of the blurred noise, components' weighted means."""
    level = cv2.medianBlur(cv2.resize(image, None, fx=1 / 16, fy=1 / 16, interpolation=cv2.INTER_AREA), 5)
    residual = image - cv2.resize(level, image.shape[::-1], interpolation=cv2.INTER_LINEAR)
    blurred = cv2.GaussianBlur(residual, (0, 0), sigma_px)
    noise = 1.4826 * float(np.median(np.abs(blurred[::4, ::4])))
    mask = (blurred > 5.0 * noise).astype(np.uint8)
    count, labels = cv2.connectedComponents(mask)
    rows, columns = np.nonzero(mask)
    label, weight = labels[rows, columns], blurred[rows, columns]
    total = np.bincount(label, weight, count)[1:]
    sums = [np.bincount(label, weight * q, count)[1:] for q in (columns, rows)]
    return np.stack([s / total for s in sums], axis=1)


def available_finders() -> dict[str, Finder]:
    """Name to detector of those that are installed; ours first."""
    from importlib.util import find_spec

    finders: dict[str, Finder] = {"startrack": startrack, "startrack, nothing known": startrack_blind}
    for module, name, finder in (
        ("sep", "sep + winpos", sep_winpos),
        ("cv2", "OpenCV blurred components", blurred_components),
        ("photutils", "photutils DAOStarFinder", dao_star_finder),
        ("tetra3rs", "tetra3rs", tetra3rs_centroids),
    ):
        if find_spec(module):
            finders[name] = finder
    return finders
