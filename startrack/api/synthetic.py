"""A pose to a synthetic image, and the expected accuracy on a terrain."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from startrack.camera import Camera
from startrack.chain import Time, angle_rad, duration_s, load_camera_input, terrain_input, time_input
from startrack.core.errors import BadInput
from startrack.core.files import file_stem
from startrack.core.types import Exposure
from startrack.rendering import Series, Truth, load_sky_catalog
from startrack.rendering import render as render_scene
from startrack.terrain import Terrain

if TYPE_CHECKING:
    from astropy.units import Quantity
    from numpy.typing import ArrayLike

    from startrack.applications.prediction import Prediction


def render(
    camera: str | Camera = "fisheye-2048",
    terrain: str | Terrain = "shackleton-thesis",
    *,
    time: Time = None,
    position_m: tuple[float, float] | None = None,
    heading: float | Quantity | None = None,
    seed: int = 0,
    number: int = 0,
    **settings: Any,
) -> tuple[Exposure, Truth]:
    """A synthetic exposure, and the truth about it. The same arguments give the same pixels.

    Args:
        camera: as for `locate`; it needs a `[sensor]`.
        terrain: as for `locate`.
        time: middle of the exposure, as for `locate`. None: drawn from the seed, like all that is not given.
        position_m: (east, north) from the terrain's origin [m].
        heading: azimuth of the rover's nose: an angle, or degrees.
        seed: of sky, sensor and noise.
        number: of the exposure within the series of this seed.
        settings: further fields of `startrack.rendering.Series`, such as `exposure_s` or `sky_v_mag_arcsec2`.

    Raises:
        BadInput: bad_calibration without a sensor, bad_terrain where no camera can stand there.
        ValueError: `heading` is no angle.
    """
    lens = load_camera_input(camera)
    ground = terrain_input(terrain, None)
    catalog = load_sky_catalog("auto").brighter_than(settings.get("faint_v_mag", Series.faint_v_mag) or np.inf)
    east_m, north_m = position_m if position_m is not None else (None, None)
    series = Series(
        camera=lens,
        terrain=ground,
        seed=seed,
        time_utc=time_input(time),
        east_m=east_m,
        north_m=north_m,
        heading_rad=None if heading is None else angle_rad(heading, "heading") % (2 * np.pi),
        **{"catalog": catalog, **settings},
    )
    scene, rng = series.scene(number, f"{file_stem(ground.name)}-{seed}-{number:03d}")
    return render_scene(scene, rng=rng)


def predict(
    camera: str | Camera,
    terrain: str | Terrain,
    *,
    time: Time | tuple[Time, Time],
    positions_m: ArrayLike | None = None,
    spacing_m: float | None = None,
    exposure: float | Quantity | None = None,
    sky_v_mag_arcsec2: float = 22.0,
    draws: int = 10,
    seed: int = 0,
    localizer: str = "posterior",
) -> Prediction:
    """Expected accuracy of positions over the search area of a terrain, or at given positions.

    Evidence of the stars is drawn at every place and located as `locate` does with the stars alone.

    Args:
        camera: as for `locate`; it needs a `[sensor]`.
        terrain: as for `locate`.
        time: middle of the exposures, as for `locate`; of a pair the draws are evenly spaced between both.
        positions_m: (k, 2) east and north from the terrain's origin [m]. None: cells of the search area.
        spacing_m: of the cells [m]. None: a tenth of the search area, or a little less.
        exposure: an astropy duration, or seconds. None: a V 6 star on the axis reaches 5 sigma.
        sky_v_mag_arcsec2: diffuse light of the sky.
        draws: at each place.
        seed: of the draws.
        localizer: as `--localizer`.

    Returns:
        The prediction: `positions_m` (k, 2), `cells` (arrays (k,) by name, as the columns of predict.ecsv), `summary`.

    Raises:
        BadInput: as `locate`; bad_calibration without a sensor.
        ValueError: positions of another shape, or where no camera can stand.
    """
    from startrack.applications.prediction import predict_positions

    first, last = time if isinstance(time, tuple) else (time, time)
    start, end = time_input(first), time_input(last)
    if start is None or end is None:
        raise BadInput("no_time", "give time=: the sky depends on it")
    return predict_positions(
        load_camera_input(camera), terrain_input(terrain, None), (start, end), positions_m=positions_m,
        spacing_m=spacing_m, exposure_s=duration_s(exposure), sky_v_mag_arcsec2=sky_v_mag_arcsec2, draws=draws,
        seed=seed, localizer=localizer,
    )  # fmt: skip
