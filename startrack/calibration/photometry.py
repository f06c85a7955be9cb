"""The [sensor] table of a camera file from a calibration, and what it lacks: nothing is invented."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from startrack.calibration.acceptance import RINGS
from startrack.calibration.region_growing import Joint
from startrack.calibration.sensor import SensorFacts, measured_sensor
from startrack.calibration.throughput import Light, measured_light
from startrack.camera import Sensor


@dataclass(frozen=True, kw_only=True)
class Given:
    """What the user knows of the sensor; None where not."""

    gain_e_per_adu: float | None = None
    read_noise_e: float | None = None
    bias_adu: float | None = None


@dataclass(frozen=True, kw_only=True)
class Photometry:
    """Measured and given facts, the sensor that they make (None where one is missing), and what is missing."""

    light: Light | None
    facts: SensorFacts
    sensor: Sensor | None
    notes: tuple[str, ...]


def photometry(joint: Joint, given: Given) -> Photometry:
    """All that the exposures tell of light and sensor."""
    facts = measured_sensor(joint, RINGS)
    light = measured_light(joint, facts.light_1)
    notes: list[str] = []
    bias = given.bias_adu if given.bias_adu is not None else facts.bias_adu
    gain = given.gain_e_per_adu
    if gain is None and facts.transfer is not None:
        gain = facts.transfer.gain_e_per_adu
    noise = given.read_noise_e
    if noise is None and facts.transfer is not None and bias is not None:
        noise = facts.transfer.read_noise_e(bias)
    if light is None:
        notes.append("zero point: not measured; the images must say their exposure time (EXPTIME, exposure_s), and 30 "
                     "unsaturated stars are needed")  # fmt: skip
    if gain is None:
        notes.append("gain: not measured; give two pictures of equal exposure with bright and dark parts of sky, or "
                     "--gain")  # fmt: skip
    elif given.gain_e_per_adu is None and not facts.same_sky:
        notes.append("gain: the sky moved between the pictures, and faint stars make it some per cent too low; best "
                     "are two pictures in quick succession")  # fmt: skip
    if bias is None:
        notes.append("bias: not measured; no dark corner outside the image circle: give --bias")
    if noise is None:
        notes.append("read noise: not measured; it needs gain and bias, or --read-noise")
    if light is not None and light.extinction_mag is None:
        notes.append("extinction: not told apart from vignetting; what the air takes is in zero point and vignetting")
    if facts.hot_px is None:
        notes.append("hot pixels: a list needs two pictures between which the sky has turned")
    sensor = None
    if light is not None and gain is not None and bias is not None:
        known: dict[str, Any] = {
            "read_noise_e": noise,
            "saturation_adu": facts.saturation_adu,
            "psf_sigma_px": facts.psf_sigma_px,
        }
        sensor = Sensor(
            zero_point_e_per_s=light.zero_point_adu_per_s * gain,
            gain_e_per_adu=gain,
            bias_adu=bias,
            vignetting=light.vignetting,
            **{key: value for key, value in known.items() if value is not None},
        )
    else:
        notes.append("[sensor] is left out of the camera file: it needs zero point, gain and bias")
    return Photometry(light=light, facts=facts, sensor=sensor, notes=tuple(notes))


def photometry_dict(found: Photometry) -> dict[str, Any]:
    """For the JSON record."""
    light, facts = found.light, found.facts
    return {
        "light": None if light is None else vars(light) | {"vignetting": list(light.vignetting)},
        "gain_e_per_adu": None if facts.transfer is None else facts.transfer.gain_e_per_adu,
        "gain_sigma_e_per_adu": None if facts.transfer is None else facts.transfer.gain_sigma,
        "bias_adu": facts.bias_adu,
        "saturation_adu": facts.saturation_adu,
        "psf_sigma_px": facts.psf_sigma_px,
        "psf_by_ring_px": list(facts.psf_by_ring_px),
        "hot_pixels": None if facts.hot_px is None else len(facts.hot_px),
        "notes": list(found.notes),
    }
