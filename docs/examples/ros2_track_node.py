"""A ROS 2 node that does what `startrack track --follow` does: one image after the other to the pose by all up to it.

Subscriptions: `image` (sensor_msgs/Image; the stamp is the middle of the exposure) and `odom` (nav_msgs/Odometry of the
rover's body). Publication: `pose` (geometry_msgs/PoseWithCovarianceStamped) in the frame of the parameter `map_frame`:
x east, y north, z up (REP-103, REP-105) from the terrain's origin; its orientation is that of the body (x forward, y
left, z up), its position that of the camera. `path` (nav_msgs/Path) has the poses so far. From then on the transform
from `map_frame` to `odom_frame` is broadcast (tf2) with each odometry message. An image that is refused, or left
out, gives none of them.

    python ros2_track_node.py --ros-args -p camera:=fisheye-2048 -p terrain:=shackleton-thesis \
        -r image:=/camera/image_raw -r odom:=/wheel/odometry
"""

import math

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry as OdometryMessage
from nav_msgs.msg import Path
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Image
from tf2_ros import TransformBroadcaster

from startrack import BadInput, load_camera, load_terrain
from startrack.applications.tracking import Odometry, Track, TrackSession
from startrack.estimation.observations import OdometryErrors
from startrack.exposure import exposure_of_message

ODOMETRY_QUEUE = 10_000  # messages: odometry that comes while an image is located must wait, not be dropped
MAX_VARIANCE_M2 = 1e6  # a position that is no better (1 km) gives no transform: a track that nothing vouches for yet
PARAMETERS = {
    "camera": "fisheye-2048",  # a file, or the name of a shipped one
    "terrain": "shackleton-thesis",  # the same
    "map_frame": "map",
    "odom_frame": "odom",  # of the odometry's poses; empty: no transform is broadcast
    "camera_in_body_m": [0.0, 0.0, 0.0],  # x, y, z of the camera in the body whose poses the odometry has
    "transform_lasts_s": 60.0,  # so long after its image a transform is broadcast
    "exposure_s": math.nan,  # that an image message does not have; not a number: not known
    "time_sigma_s": math.nan,  # of the clock, the same
    "odometry_sigma": 0.02,  # of a move's length
    "odometry_floor_m": 0.05,
    "max_speed_m_s": 10.0,
    # The track states no error of the height and of the attitude. These are as good as unknown to a filter that
    # receives the pose; state what is known of the map and of the camera's mount.
    "up_sigma_m": 1e3,
    "attitude_sigma_rad": 1e3,
}


class TrackNode(Node):
    """Keeps what the track needs of each image, and the odometry; publishes a pose once the odometry reaches it."""

    def __init__(self) -> None:
        super().__init__("startrack")
        given = {name: self.declare_parameter(name, value).value for name, value in PARAMETERS.items()}
        self.map_frame, self.odom_frame = given["map_frame"], given["odom_frame"]
        self.camera_in_body_m, self.lasts_s = given["camera_in_body_m"], given["transform_lasts_s"]
        self.facts = {name: given[name] for name in ("exposure_s", "time_sigma_s") if not math.isnan(given[name])}
        self.session = TrackSession(
            stated_camera=load_camera(given["camera"]), stated_terrain=load_terrain(given["terrain"]),
            odometry_errors=OdometryErrors(
                given["odometry_sigma"], given["odometry_floor_m"], given["max_speed_m_s"]
            ),
        )  # fmt: skip
        variances = [0.0, 0.0, given["up_sigma_m"] ** 2, *3 * [given["attitude_sigma_rad"] ** 2]]
        self.covariance = np.diag(variances)  # (6, 6) of x, y, z and the rotations about them; x and y by the track
        self.poses: list[list[float]] = []  # rows time, position, quaternion
        self.stamps: dict[str, object] = {}  # of images that were not filtered yet, by their names
        self.images = 0
        self.broadcaster = TransformBroadcaster(self)
        self.map_from_odom: tuple[float, np.ndarray, Rotation] | None = None  # time [s] of its image, move [m], turn
        self.publisher = self.create_publisher(PoseWithCovarianceStamped, "pose", 10)
        self.path, self.path_publisher = Path(), self.create_publisher(Path, "path", 10)
        self.path.header.frame_id = self.map_frame
        self.create_subscription(Image, "image", self.on_image, qos_profile_sensor_data)
        self.create_subscription(OdometryMessage, "odom", self.on_odometry, ODOMETRY_QUEUE)

    def on_odometry(self, message: OdometryMessage) -> None:
        """Keep a pose; then the odometry may reach an image that waits."""
        at, q, stamp = message.pose.pose.position, message.pose.pose.orientation, message.header.stamp
        time_s = stamp.sec + 1e-9 * stamp.nanosec
        if self.poses and time_s <= self.poses[-1][0]:
            self.get_logger().warning(f"odometry at {time_s:.6f} s is not later than the last one: not used")
            return
        self.poses.append([time_s, at.x, at.y, at.z, q.x, q.y, q.z, q.w])
        self.publish_newest()
        self.broadcast(stamp)

    def on_image(self, message: Image) -> None:
        """Locate an image and keep its evidence."""
        stamp, name = message.header.stamp, f"image-{self.images:06d}"
        self.images += 1
        if not self.poses or stamp.sec + 1e-9 * stamp.nanosec < self.poses[0][0]:
            self.get_logger().warning(f"{name} is earlier than the odometry: not used")
            return
        try:
            frame = self.session.add_exposure(exposure_of_message(message, name, **self.facts))
        except BadInput as cause:
            self.get_logger().error(f"{name} {cause.reason}: {cause}")
            return
        if frame.reason:
            self.get_logger().warning(f"{name} is refused: {frame.reason}: {frame.message}")
        self.stamps[name] = stamp
        self.publish_newest()

    def publish_newest(self) -> None:
        """Publish the pose of each image that the odometry has reached since the last call."""
        if len(self.poses) < 2 or not self.session.waits:
            return
        try:
            rows = np.array(self.poses)
            odometry = Odometry(time_s=rows[:, 0], position_m=rows[:, 1:4], quat_xyzw=rows[:, 4:])
            for track in self.session.newest(odometry):
                self.publish(track, odometry)
        except (BadInput, ValueError) as cause:
            self.get_logger().error(f"the odometry cannot be used: {cause}")

    def publish(self, track: Track, odometry: Odometry) -> None:
        """Publish the pose of a `track` of one image, and keep the transform; neither where it is not used or known."""
        frame, position_m = track.frames[0], track.filtered.position_enu_m[0]
        stamp = self.stamps.pop(frame.name, None)
        if stamp is None or frame.status != "used" or frame.quat_xyzw_body_enu is None:
            return
        if not np.isfinite(position_m).all():
            return
        message = PoseWithCovarianceStamped()
        message.header.stamp, message.header.frame_id = stamp, self.map_frame
        pose, covariance = message.pose.pose, self.covariance.copy()
        pose.position.x, pose.position.y, pose.position.z = position_m.tolist()
        x, y, z, w = frame.quat_xyzw_body_enu.tolist()  # from enu to the body; a ROS pose has that from the body
        pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = -x, -y, -z, w
        covariance[:2, :2] = track.filtered.covariance_m2[0]
        message.pose.covariance = covariance.ravel().tolist()
        self.publisher.publish(message)
        self.publish_path(PoseStamped(header=message.header, pose=pose))
        if self.odom_frame and np.trace(track.filtered.covariance_m2[0]) < MAX_VARIANCE_M2:
            R_map_body = Rotation.from_quat(frame.quat_xyzw_body_enu).inv()
            self.keep_transform(stamp, position_m - R_map_body.apply(self.camera_in_body_m), R_map_body, odometry)

    def publish_path(self, newest: PoseStamped) -> None:
        """Publish the poses so far with the `newest` one; each is by the images up to its own."""
        self.path.poses = [*self.path.poses, newest]
        self.path.header.stamp = newest.header.stamp
        self.path_publisher.publish(self.path)

    def keep_transform(self, stamp: object, body_m: np.ndarray, R_map_body: Rotation, odometry: Odometry) -> None:
        """Keep map <- odom = (map <- body) (odom <- body)^-1, with the `odometry` at the time of the image."""
        time_s = stamp.sec + 1e-9 * stamp.nanosec
        ((at_m,), (R_odom_body,)) = odometry.poses_at(np.array([time_s]))
        R_map_odom = R_map_body * R_odom_body.inv()
        self.map_from_odom = time_s, body_m - R_map_odom.apply(at_m), R_map_odom

    def broadcast(self, stamp: object) -> None:
        """Broadcast the transform that is kept, with the `stamp` of the newest odometry; none long after its image.

        Where odometry and transform have the same stamps, tf2 does not interpolate between two corrections.
        """
        if self.map_from_odom is None or stamp.sec + 1e-9 * stamp.nanosec > self.map_from_odom[0] + self.lasts_s:
            return
        _, move_m, R_map_odom = self.map_from_odom
        message = TransformStamped()
        message.header.stamp, message.header.frame_id = stamp, self.map_frame
        message.child_frame_id = self.odom_frame
        move, turn = message.transform.translation, message.transform.rotation
        move.x, move.y, move.z = move_m.tolist()
        turn.x, turn.y, turn.z, turn.w = R_map_odom.as_quat().tolist()
        self.broadcaster.sendTransform(message)


def main() -> None:
    """Run the node until it is stopped."""
    rclpy.init()
    rclpy.spin(TrackNode())


if __name__ == "__main__":
    main()
