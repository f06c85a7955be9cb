"""Effect of the camera file's uncertainty on the evidence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from stage_helpers import as_stage

from startrack.catalog import load_catalog
from startrack.chain import Oriented, Settings, measurement
from startrack.chain.measurement import measure_evidence


def with_covariance(camera, sigma_px):
    """The camera with errors of its radial law that grow to the rim: sigma_px at 90 degrees."""
    order = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
    sigma = np.array([0, 0, 0, 0, sigma_px / camera.focal_px[0] / (np.pi / 2) ** 3, 0, 0, 0])
    return replace(camera, covariance_order=order, covariance=np.diag(sigma**2))


def photometry(result):
    return measure_evidence(as_stage(result, Oriented), result.terrain, Settings(deep_stars=False)).photometry


def test_an_uncertain_lens_weakens_the_evidence_at_the_rim(located):
    sure = photometry(located.result)
    camera = with_covariance(located.result.camera, 2.0)
    doubtful = photometry(replace(located.result, camera=camera))
    assert np.array_equal(sure.star, doubtful.star)
    rays = located.result.stars.rays_icrs[sure.star] @ located.result.attitude.R_cam_icrs.T
    rim = (rays[:, 2] < 0.2) & sure.usable & (sure.llr > 8)
    axis = (rays[:, 2] > 0.95) & sure.usable & (sure.llr > 8)
    assert rim.sum() > 10 and axis.sum() > 10
    bright = sure.flux_e > 20 * sure.sigma_e
    assert np.median(sure.llr[rim & ~bright]) > np.median(doubtful.llr[rim & ~bright])
    np.testing.assert_allclose(doubtful.llr[axis], sure.llr[axis], atol=0.5)


def test_no_evidence_beyond_the_calibrated_angle(located):
    camera = replace(located.result.camera, calibrated_angle_rad=float(np.radians(60)))
    light = photometry(replace(located.result, camera=camera))
    rays = located.result.stars.rays_icrs[light.star] @ located.result.attitude.R_cam_icrs.T
    beyond = rays[:, 2] < np.cos(np.radians(60))
    assert beyond.sum() > 100
    assert not light.usable[beyond].any()
    assert np.all(light.llr[beyond] == 0)


def test_gaia_stars_are_added_to_the_whole_catalogue_only(located, monkeypatch):
    monkeypatch.setattr(measurement, "COMPLETE_V_MAG", -10.0)  # as if every frame were deep enough
    result, site = located.result, located.result.site
    whole = load_catalog().at(result.exposure.time_utc, None)
    number = np.searchsorted(np.sort(whole.hip), result.stars.hip[result.identification.star])
    rows = np.argsort(whole.hip)[number]
    names = replace(result.names, stars=result.names.stars.take(slice(0)))
    full = replace(result, stars=whole, identification=replace(result.identification, star=rows), names=names)
    deep = measurement.add_gaia_stars(full, site)
    assert deep.catalog_name == "hipparcos+gaia"
    assert np.array_equal(deep.stars.hip[deep.identification.star], whole.hip[rows])
    part = replace(full, stars=whole.take(slice(0, len(whole) - 1)))
    assert measurement.add_gaia_stars(part, site) is part
