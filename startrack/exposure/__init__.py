"""One image with the facts that travel with it: read, validate, write.

`read.py` opens a file and picks its decoder (`png.py`, `tiff.py`, `jpeg.py`, `fits.py`, `mosaic.py` for camera raw
files); `metadata.py` finds time, exposure seconds, camera and terrain; `write.py` writes images and sidecars. A file
that cannot be used raises `startrack.types.BadInput` and no other exception.
"""

from startrack.exposure.decoded import are_fractions
from startrack.exposure.metadata import Facts, with_facts
from startrack.exposure.read import exposure_of, read_exposure
from startrack.exposure.write import write_exposure, write_sidecar

__all__ = [
    "Facts", "are_fractions", "exposure_of", "read_exposure", "with_facts", "write_exposure",
    "write_sidecar",
]  # fmt: skip
