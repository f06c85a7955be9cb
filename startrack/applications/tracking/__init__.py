"""Many exposures: tracks of a camera at rest or on a drive; odometry from text and ROS bags."""

from startrack.applications.tracking.files import (
    FRAME_QUANTITIES,
    TRACK,
    frame_records,
    track_page,
    track_record,
    write_track,
)
from startrack.applications.tracking.frame_estimate import estimate_frame
from startrack.applications.tracking.observed_frame import FrameStore, ObservedFrame, observe_frame, rows_near_skyline
from startrack.applications.tracking.odometry import Odometry, OdometryFile, read_odometry
from startrack.applications.tracking.picture import draw_track
from startrack.applications.tracking.session import TrackSession, follow_images
from startrack.applications.tracking.track import Track, TrackFrame, Trajectory, estimate_track
from startrack.applications.tracking.track_errors import TrackErrors
from startrack.exposure import read_bag_exposures

__all__ = [
    "FRAME_QUANTITIES", "TRACK", "FrameStore",
    "ObservedFrame", "Odometry", "OdometryFile", "Track", "TrackErrors", "TrackFrame", "TrackSession", "Trajectory",
    "draw_track", "estimate_frame", "estimate_track", "follow_images", "frame_records", "observe_frame",
    "read_bag_exposures", "read_odometry", "rows_near_skyline", "track_page", "track_record", "write_track",
]  # fmt: skip
