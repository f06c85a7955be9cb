"""Exposures from the image messages of ROS bags."""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.errors import BadInput
from startrack.exposure import Facts, decode_bytes, exposure_of_decoded
from startrack.exposure.decoded import Decoded, check_size, grey_float32, largest_value
from startrack.files import FilePath, printable
from startrack.tracking.bag import IMAGE_TYPES, Message, read_messages
from startrack.types import Exposure

# Encodings of sensor_msgs/Image (image_encodings.h) of one channel.
RAW_ENCODING = re.compile(r"(?:mono|bayer_(?P<pattern>rggb|bggr|gbrg|grbg))(?P<bits>8|16)")
BAYER_IN_FORMAT = re.compile(r"\s*bayer_(?P<pattern>rggb|bggr|gbrg|grbg)(?:8|16)\b")


def read_bag_exposures(
    path: FilePath,
    topic: str | None = None,
    *,
    time_sigma_s: float | None = None,
    exposure_s: float | None = None,
    camera: str | None = None,
    terrain: str | None = None,
    mask: str | None = None,
) -> Iterator[Exposure]:
    """The exposures of a bag's image `topic` (None: its only one), one by one, in the bag's order.

    sensor_msgs/Image in mono8, mono16 or a Bayer encoding, and sensor_msgs/CompressedImage of PNG or JPEG. The time
    of a message's header is taken as the middle of the exposure. The exposures are named BAG-0000, BAG-0001, ...
    `path` is a file or the folder of a ROS 2 bag. A bag does not have `exposure_s`, `time_sigma_s`, `camera`, `terrain`
    and `mask`: they are as in `read_exposure`.

    Raises:
        BadInput: bad_image with the file and the cause, in one line.
        ValueError: `time_sigma_s` is no usable number of seconds.
    """
    given: dict[str, Any] = {
        "time_sigma_s": time_sigma_s, "exposure_s": exposure_s, "camera": camera, "terrain": terrain, "mask": mask
    }  # fmt: skip
    messages = read_messages(path, IMAGE_TYPES, topic, reason="bad_image", flag="--image-topic")
    for number, message in enumerate(messages):
        try:
            decoded, pattern = _decode(message)
        except BadInput as cause:
            where = f"{printable(path)}: image {number} of {message.topic}"
            raise BadInput(cause.reason, f"{where}: {cause}") from cause
        facts = Facts(time_utc=_utc(message.stamp_ns), bayer_pattern=pattern, **given)
        name = f"{Path(path).stem}-{number:04d}"
        yield exposure_of_decoded(decoded, facts, raw=message.raw, name=name, path=str(path))


def _utc(stamp_ns: int) -> datetime:
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=stamp_ns // 1000)


def _decode(message: Message) -> tuple[Decoded, str | None]:
    """Pixels of a message, and the pattern of its mosaic. Raises BadInput bad_image."""
    content = message.content
    if message.kind == "sensor_msgs/msg/CompressedImage":
        bayer = BAYER_IN_FORMAT.match(str(content.format))
        return decode_bytes(bytes(content.data)), bayer["pattern"].upper() if bayer else None
    form = RAW_ENCODING.fullmatch(str(content.encoding))
    if form is None:
        raise BadInput(
            "bad_image", f"encoding {content.encoding!r}; startrack reads mono8, mono16, bayer_rggb8 and the like"
        )
    stored = _stored_pixels(content, np.dtype(f"{'>' if content.is_bigendian else '<'}u{int(form['bits']) // 8}"))
    pixels, _ = grey_float32(stored)
    decoded = Decoded(pixels_adu=pixels, saturation_adu=largest_value(stored.dtype))
    return decoded, form["pattern"].upper() if form["pattern"] else None


def _stored_pixels(image: Any, dtype: np.dtype[Any]) -> NDArray[Any]:
    """The pixels (H, W) of sensor_msgs/Image, whose rows may be padded to `step` bytes."""
    width, height, step, data = int(image.width), int(image.height), int(image.step), np.asarray(image.data)
    check_size(width, height)
    if step < width * dtype.itemsize or data.size != step * height:
        raise BadInput(
            "bad_image",
            f"{width} x {height} pixels of {dtype.itemsize} bytes, {step} bytes a row, in {data.size} bytes",
        )
    rows = np.ascontiguousarray(data.reshape(height, step)[:, : width * dtype.itemsize])
    return rows.view(dtype).astype(dtype.newbyteorder("="))
