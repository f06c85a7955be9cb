"""cedar-solve, in an environment of its own: reads a star list per line, writes the solution and the CPU time.

It pins numpy 1: python -m venv PLACE && PLACE/bin/pip install cedar-solve. Run by _identify_peers.py.
"""

import json
import logging
import sys
import time

import numpy as np
import tetra3

logging.disable(logging.CRITICAL)
solver = tetra3.Tetra3("default_database")
print("ready", flush=True)
for line in sys.stdin:
    request = json.loads(line)
    centroids, fov_deg = np.array(request["xy_px"])[:, ::-1], request["fov_deg"]
    error_deg = request.get("error_1", 0.02) * fov_deg
    start = time.process_time()
    found = solver.solve_from_centroids(
        centroids, tuple(request["size_px"][::-1]), fov_estimate=fov_deg, fov_max_error=error_deg
    )
    ms = 1e3 * (time.process_time() - start)
    print(json.dumps({"ms": ms, **{key: found[key] for key in ("RA", "Dec", "Roll")}}), flush=True)
