"""Many exposures: tracks of a camera at rest or on a drive; odometry from text and ROS bags."""

from startrack.applications.tracking.observe import ObservedFrame, observe_frame
from startrack.applications.tracking.odometry import Odometry, read_odometry
from startrack.applications.tracking.session import TrackSession
from startrack.applications.tracking.shared import TrackErrors
from startrack.applications.tracking.track import CrestHeights, Track, TrackFrame, Trajectory, estimate_track
from startrack.exposure import read_bag_exposures

__all__ = [
    "CrestHeights", "ObservedFrame", "Odometry", "Track", "TrackErrors", "TrackFrame", "TrackSession", "Trajectory",
    "estimate_track", "observe_frame", "read_bag_exposures", "read_odometry",
]  # fmt: skip
