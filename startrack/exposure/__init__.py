"""Image with the facts that travel with it: read, validate, write.

`decoding.py` opens a file and picks its decoder (`png.py`, `tiff.py`, `jpeg.py`, `fits.py`, `mosaic.py` for camera
raw files); `bag.py` reads images from ROS bags; `correction.py` reads which pixels count and applies
dark frame and flat field; `facts.py` finds the other facts, in flags, the sidecar (`sidecar.py`) and the header;
`write.py` writes images and sidecars.
A file that cannot be used raises `startrack.core.errors.BadInput` and no other exception.
"""

from startrack.exposure.bag import (
    BAG_SUFFIXES,
    ODOMETRY_TYPES,
    BagImage,
    choose_bag_image,
    exposure_of_message,
    is_bag,
    list_bag_images,
    read_bag_exposures,
    read_bag_image,
    read_messages,
    split_bag_path,
)
from startrack.exposure.correction import combine_masks, mask_of, read_dark, read_flat, read_mask, touch_masked
from startrack.exposure.decoding import are_fractions
from startrack.exposure.facts import NO_TIME, Facts, check_time_sigma_s, with_facts
from startrack.exposure.fits import BLOCK_BYTES
from startrack.exposure.png import insert_png_chunks, png_chunks
from startrack.exposure.read import exposure_of, read_exposure
from startrack.exposure.sidecar import (
    IMAGE_KEYS,
    PACKING_SUFFIXES,
    PICTURE_SUFFIXES,
    SIDECAR,
    Sidecar,
    sidecar_of,
    stem,
)
from startrack.exposure.write import write_exposure, write_sidecar

__all__ = [
    "BAG_SUFFIXES", "BLOCK_BYTES", "IMAGE_KEYS", "NO_TIME", "ODOMETRY_TYPES", "PACKING_SUFFIXES",
    "PICTURE_SUFFIXES", "SIDECAR", "BagImage", "Facts", "Sidecar", "are_fractions",
    "check_time_sigma_s", "choose_bag_image", "combine_masks", "exposure_of", "exposure_of_message",
    "insert_png_chunks", "is_bag", "list_bag_images", "mask_of", "png_chunks", "read_bag_exposures",
    "read_bag_image", "read_dark", "read_exposure", "read_flat", "read_mask", "read_messages", "sidecar_of",
    "split_bag_path", "stem", "touch_masked", "with_facts", "write_exposure", "write_sidecar",
]  # fmt: skip
