"""Many exposures: odometry, and images and odometry from ROS bags."""

from startrack.tracking.bag_images import read_bag_exposures
from startrack.tracking.odometry import Odometry, read_odometry

__all__ = ["Odometry", "read_bag_exposures", "read_odometry"]
