"""One image with the facts that travel with it: read, validate, write.

`decode_file.py` opens a file and picks its decoder (`png.py`, `tiff.py`, `jpeg.py`, `fits.py`, `mosaic.py` for camera
raw files); `mask.py` reads which pixels count; `correct.py` applies dark frame and
flat field; `metadata.py` finds time, exposure seconds, camera, terrain, mask, dark frame and flat field: in flags, the
sidecar (`sidecar.py`) and the header (`header.py`); `write.py` writes images and sidecars. A file that cannot be used
raises `startrack.types.BadInput` and no other exception.
"""

from startrack.exposure.correct import correct_exposure, read_dark, read_flat
from startrack.exposure.decode_file import decode_bytes
from startrack.exposure.decoded import are_fractions
from startrack.exposure.mask import combine_masks, mask_of, read_mask, touch_masked
from startrack.exposure.metadata import Facts, with_facts
from startrack.exposure.read import exposure_of, exposure_of_decoded, read_exposure
from startrack.exposure.write import write_exposure, write_sidecar

__all__ = [
    "Facts", "are_fractions", "combine_masks", "correct_exposure", "decode_bytes", "exposure_of", "exposure_of_decoded",
    "mask_of", "read_dark", "read_exposure", "read_flat", "read_mask", "touch_masked", "with_facts", "write_exposure",
    "write_sidecar",
]  # fmt: skip
