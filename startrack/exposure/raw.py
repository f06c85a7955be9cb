"""Raw files of colour cameras (DNG, CR2, NEF, ARW, ...), read by LibRaw: the sensor's own counts, nothing developed."""

from __future__ import annotations

from importlib.util import find_spec
from io import BytesIO

import numpy as np

from startrack.exposure.decoded import Decoded, check_size, refuse


def decode_camera_raw(raw: bytes) -> Decoded:
    """The mosaic as the sensor gave it, without its masked border, black level not subtracted.

    Facts are not taken from it: such cameras write local times. `BadInput` if damaged, if its pixels are no 2 x 2
    mosaic, or where rawpy (extra `raw`) is missing.
    """
    if find_spec("rawpy") is None:
        raise refuse("is a camera raw file, which needs rawpy: pip install 'startrack[raw]'")
    import rawpy

    with rawpy.imread(BytesIO(raw)) as file:
        check_size(file.sizes.width, file.sizes.height)
        if file.raw_type is not rawpy.RawType.Flat:
            raise refuse("holds colours in layers; startrack reads mosaics")
        pattern = file.raw_pattern
        if pattern is not None and pattern.shape != (2, 2):
            raise refuse(f"has a mosaic of {pattern.shape[0]} x {pattern.shape[1]}; startrack reads 2 x 2")
        pixels = file.raw_image_visible.astype(np.float32)
        white = float(file.white_level)
    return Decoded(pixels_adu=pixels, saturation_adu=white, mosaic=pattern is not None)
