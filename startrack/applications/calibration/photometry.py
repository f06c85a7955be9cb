"""The [sensor] table of a camera file from a calibration; missing properties are named in notes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from startrack.applications.calibration.sensor import SensorProperties, measure_sensor
from startrack.applications.calibration.throughput import Throughput, measure_throughput
from startrack.camera import Sensor
from startrack.estimation.joint_fit import JointFit


@dataclass(frozen=True, kw_only=True)
class KnownSensor:
    """Properties of the sensor that the user gives; None where not known."""

    gain_e_per_adu: float | None = None
    read_noise_e: float | None = None
    bias_adu: float | None = None


@dataclass(frozen=True, kw_only=True)
class Photometry:
    """Throughput and sensor properties, the sensor made from them (None where one is missing), and notes."""

    throughput: Throughput | None
    properties: SensorProperties
    sensor: Sensor | None
    notes: tuple[str, ...]


def measure_photometry(joint: JointFit, known: KnownSensor) -> Photometry:
    """Throughput and sensor from the exposures of a calibration."""
    properties = measure_sensor(joint)
    throughput, notes = measure_throughput(joint, properties.flux_ratio)
    bias = known.bias_adu if known.bias_adu is not None else properties.bias_adu
    gain, noise, transfer = known.gain_e_per_adu, known.read_noise_e, properties.transfer
    if gain is None and transfer is not None:
        gain = transfer.gain_e_per_adu
    if noise is None and transfer is not None and bias is not None:
        noise = transfer.read_noise_e(bias)
    if gain is None:
        notes.append("gain: not measured; give two pictures of equal exposure with bright and dark parts of sky, or "
                     "--gain")  # fmt: skip
    elif known.gain_e_per_adu is None and not properties.same_sky:
        notes.append("gain: the sky moved between the pictures, and faint stars make it some per cent too low; best "
                     "are two pictures in quick succession")  # fmt: skip
    if bias is None:
        notes.append("bias: not measured; no dark corner outside the image circle: give --bias")
    if noise is None:
        notes.append("read noise: not measured; it needs gain and bias, or --read-noise")
    if properties.hot_px is None:
        notes.append("hot pixels: a list needs two pictures between which the sky has turned")
    sensor = None
    if throughput is not None and gain is not None and bias is not None:
        optional: dict[str, Any] = {
            "read_noise_e": noise,
            "saturation_adu": properties.saturation_adu,
            "psf_sigma_px": properties.psf_sigma_px,
        }
        sensor = Sensor(
            zero_point_e_per_s=throughput.zero_point_adu_per_s * gain,
            gain_e_per_adu=gain,
            bias_adu=bias,
            vignetting=throughput.vignetting,
            **{key: value for key, value in optional.items() if value is not None},
        )
    else:
        notes.append("[sensor] is left out of the camera file: it needs zero point, gain and bias")
    return Photometry(throughput=throughput, properties=properties, sensor=sensor, notes=tuple(notes))


def photometry_dict(found: Photometry) -> dict[str, Any]:
    """The photometry's part of the JSON record."""
    throughput, properties = found.throughput, found.properties
    light = None if throughput is None else vars(throughput) | {"vignetting": list(throughput.vignetting)}
    return {
        "light": light,
        "gain_e_per_adu": None if properties.transfer is None else properties.transfer.gain_e_per_adu,
        "gain_sigma_e_per_adu": None if properties.transfer is None else properties.transfer.gain_sigma,
        **{key: getattr(properties, key) for key in ("bias_adu", "saturation_adu", "psf_sigma_px")},
        "psf_by_ring_px": list(properties.psf_by_ring_px),
        "hot_pixels": None if properties.hot_px is None else len(properties.hot_px),
        "notes": list(found.notes),
    }
