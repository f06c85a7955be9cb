"""The observations of a track in GTSAM: iSAM2 and a fixed-lag smoother, frame by frame. Runs where gtsam is installed.

    PYTHON benchmarks/_gtsam_worker.py IN.npz OUT.npz

Every post is a variable of its own; the factors are linear.
"""

from __future__ import annotations

import sys
import time

import gtsam
import numpy as np

LAG_FRAMES = 10
SHARED = gtsam.symbol("b", 0)


def main() -> None:
    """Read the observations, estimate, write positions and times."""
    data = dict(np.load(sys.argv[1], allow_pickle=True))
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(1e9)  # the factors are linear
    found = {}
    isam = gtsam.ISAM2(parameters)
    found["isam2"], found["isam2_s"] = run(data, lambda g, v, _: isam.update(g, v), isam.calculateEstimate, np.inf)
    last = isam.calculateEstimate()
    found["smoothed"] = np.array([last.atVector(gtsam.symbol("x", k)) for k in range(len(data["mean"]))])
    lagged = gtsam.IncrementalFixedLagSmoother(float(LAG_FRAMES), parameters)
    found["lag"], found["lag_s"] = run(data, lagged.update, lagged.calculateEstimate, LAG_FRAMES)
    np.savez(sys.argv[2], **found)


def run(data, update, estimate, lag):
    """Position (n, 2) of each frame at its own time, and seconds (n,) of CPU."""
    positions, seconds, seen = [], [], {}
    for k in range(len(data["mean"])):
        start = time.process_time()
        graph, values, stamps = gtsam.NonlinearFactorGraph(), gtsam.Values(), {}
        here = gtsam.symbol("x", k)
        values.insert(here, data["mean"][k][:2])
        if k == 0:
            add_prior(graph, values, SHARED, data["response"][0].shape[1] - 2)
        else:
            graph.add(move_factor(data, k - 1))
        posts = [gtsam.symbol("h", int(p)) for p in data["post"][k]]
        for post in posts:
            if post not in seen or seen[post] < k - 1 - lag:  # new, or no longer in the window
                add_prior(graph, values, post)
            seen[post] = k
        stamps = dict.fromkeys([here, SHARED, *posts], float(k))
        graph.add(frame_factor(data, k, [here, SHARED, *posts]))
        update(graph, values, stamps)
        positions.append(estimate().atVector(here))
        seconds.append(time.process_time() - start)
    return np.array(positions), np.array(seconds)


def add_prior(graph, values, key, count=1) -> None:
    """The `count` shared errors, or a post, in their standard deviations."""
    graph.add(gtsam.PriorFactorVector(key, np.zeros(count), gtsam.noiseModel.Unit.Create(count)))
    values.insert(key, np.zeros(count))


def frame_factor(data, k, keys):
    """The observation of a frame."""
    unit = np.linalg.inv(np.linalg.cholesky(data["noise"][k]))
    by_post = data["by_post"][k]
    blocks = [data["response"][k][:, :2], data["response"][k][:, 2:], *by_post.T[:, :, None]]
    return linear_factor(keys, [unit @ block for block in blocks], unit @ data["mean"][k])


def move_factor(data, k):
    """The move from frame k to the next one."""
    unit = np.eye(2) / data["sigma_m"][k]
    return linear_factor([gtsam.symbol("x", k), gtsam.symbol("x", k + 1)], [-unit, unit], unit @ data["move_m"][k])


def linear_factor(keys, blocks, target):
    """Error: sum of the blocks times the variables, less the target, in standard deviations."""

    def error(this, values, jacobians):
        if jacobians is not None:
            for number, block in enumerate(blocks):
                jacobians[number] = block
        return sum(block @ values.atVector(key) for key, block in zip(keys, blocks, strict=True)) - target

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(target)), keys, error)


if __name__ == "__main__":
    main()
