"""allclear, in an environment of its own: fits one picture of the sky, writes the fit and the CPU time as JSON.

    PYTHON _allclear_worker.py FRAME.fits LATITUDE LONGITUDE TIME DIRECTIONS.json

python -m venv PLACE && PLACE/bin/pip install allclear. Run by identification_peers.py. DIRECTIONS.json is a list of
azimuth and apparent altitude [deg]; the answer has the pixels to which the fitted model projects them, in the picture
as it is and mirrored.
"""

import contextlib
import io
import json
import resource
import sys
import tempfile
from pathlib import Path

import numpy as np
from allclear.cli import main
from allclear.instrument import InstrumentModel

frame, latitude, longitude, when, directions = sys.argv[1:]
answer = {"solved": False}
with tempfile.TemporaryDirectory() as folder:
    model = Path(folder) / "model.json"
    words = ["instrument-fit", "--frames", frame, "--lat", latitude, f"--lon={longitude}", "--time", when]
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said), contextlib.suppress(SystemExit):
        main([*words, "--output", str(model)])
    if model.exists():
        found = InstrumentModel.load(model)
        az, alt = np.radians(np.array(json.loads(Path(directions).read_text()))).T
        x, y = found.to_camera_model().sky_to_pixel(az, alt)
        mirrored = found.image_width - 1 - x if found.mirrored else x
        answer = {
            "solved": found.quality_state != "fail", "stars": int(found.n_stars_matched), "x": mirrored.tolist(),
            "y": y.tolist(),
        }  # fmt: skip
used = resource.getrusage(resource.RUSAGE_SELF)
answer["cpu_s"] = used.ru_utime + used.ru_stime
print(json.dumps(answer))
