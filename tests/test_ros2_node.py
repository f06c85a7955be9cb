"""The ROS 2 node of docs/examples, over a stand-in of rclpy: its poses are those of `track` of the same images."""

import importlib.util
from dataclasses import replace
from datetime import UTC

import numpy as np
import pytest
from drive_helpers import render_small_drive
from page_helpers import ROOT
from scipy.spatial.transform import Rotation

import startrack
from startrack.applications.tracking import read_odometry
from startrack.core.errors import BadInput
from startrack.exposure import exposure_of_message, read_exposure
from startrack.frames import R_from_quat_xyzw

pytest.importorskip("rosbags", reason="the extra `ros` is not installed")
from ros_stand_in import image_message, install, odometry_message, stamped

EXAMPLE = ROOT / "docs/examples/ros2_track_node.py"
REFUSED = 1  # number of the image that shows no star
CAMERA_IN_BODY_M = [0.4, -0.1, 1.2]
LASTS_S = 1e4  # of a transform after its image; the images are minutes apart
TOLERANCE_M = 1e-4  # a time in seconds has 0.2 us as a float: less than 1 um of the sky's turn, or of a rover's move


def stamp_ns(exposure):
    """Of the middle of an exposure."""
    return round(exposure.time_utc.astimezone(UTC).timestamp() * 1e6) * 1000


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Camera file, exposures 25 m apart of which one shows no star, their odometry, and the true poses."""
    folder = tmp_path_factory.mktemp("ros")
    render_small_drive(folder, "-6900,4700\n-6825,4700")
    exposures = [read_exposure(path) for path in sorted((folder / "frames").glob("*.png"))]
    noise = np.random.default_rng(4).normal(500.0, 20.0, exposures[0].pixels_adu.shape).astype(np.float32)
    exposures[REFUSED] = replace(exposures[REFUSED], pixels_adu=np.rint(noise))
    poses = [read_odometry(folder / "frames" / f"{name}.tum") for name in ("odometry", "truth")]
    return folder / "small.toml", exposures, *poses


@pytest.fixture
def node(drive, monkeypatch):
    """The example's node, with the drive's camera and the thesis's crater."""
    first = drive[1][0]
    facts = {"exposure_s": first.exposure_s, "time_sigma_s": first.time_sigma_s, "camera_in_body_m": CAMERA_IN_BODY_M}
    facts["transform_lasts_s"] = LASTS_S
    install(monkeypatch, camera=str(drive[0]), terrain="shackleton-thesis", **facts)
    spec = importlib.util.spec_from_file_location("ros2_track_node", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.TrackNode()


def odometry_messages(odometry):
    rows = zip(odometry.time_s, odometry.position_m, odometry.quat_xyzw, strict=True)
    return [odometry_message(round(time_s * 1e6) * 1000, *pose) for time_s, *pose in rows]


def test_poses_are_those_of_the_track_and_a_refused_image_has_none(drive, node):
    camera, exposures, odometry, truth = drive
    track = startrack.track(exposures, camera=str(camera), terrain="shackleton-thesis", odometry=odometry)
    assert [frame.status for frame in track.frames].count("refused") == 1
    published, counts = node.publishers["pose"].messages, []
    moves = odometry_messages(odometry)
    node.callbacks["odom"](moves[0])
    for exposure, move in zip(exposures, [None, *moves[1:]], strict=True):
        node.callbacks["image"](image_message(stamp_ns(exposure), exposure.pixels_adu))
        if move is not None:
            assert len(published) == (counts[-1] if counts else 0)  # the odometry has not reached the image yet
            node.callbacks["odom"](move)
        counts.append(len(published))
    assert counts == [0, 1, 2, 3]  # the first image waits for a second pose, the second one is refused
    used = [k for k in range(len(exposures)) if k != REFUSED]
    assert len(node.transforms) == len(used)  # none of the refused image
    assert [sent.header.stamp for sent in node.transforms] == [move.header.stamp for move in moves[1:]]
    for sent, message, k in zip(node.transforms, published, used, strict=True):
        assert (sent.header.frame_id, sent.child_frame_id) == ("map", "odom")
        moved, turned = sent.transform.translation, sent.transform.rotation
        R_map_odom = Rotation.from_quat([turned.x, turned.y, turned.z, turned.w])
        R_odom_body = Rotation.from_quat(odometry.quat_xyzw[k])  # the odometry has a pose at each image
        body_m = R_map_odom.apply(np.array(odometry.position_m[k])) + np.array([moved.x, moved.y, moved.z])
        camera_m = body_m + (R_map_odom * R_odom_body).apply(CAMERA_IN_BODY_M)
        at, q = message.pose.pose.position, message.pose.pose.orientation
        np.testing.assert_allclose(camera_m, [at.x, at.y, at.z], rtol=0, atol=1e-6)
        off = R_map_odom * R_odom_body * Rotation.from_quat([q.x, q.y, q.z, q.w]).inv()
        assert off.magnitude() < 1e-6
    path = node.publishers["path"].messages[-1]
    assert path.header.frame_id == "map" and path.header.stamp == published[-1].header.stamp
    assert [(one.header.stamp, one.pose) for one in path.poses] == [
        (one.header.stamp, one.pose.pose) for one in published
    ]
    last_ns = stamp_ns(exposures[-1])
    for later_s, is_sent in ((LASTS_S - 1.0, True), (LASTS_S + 1.0, False)):
        count = len(node.transforms)
        node.callbacks["odom"](stamped(moves[-1], last_ns + round(later_s * 1e9)))
        assert len(node.transforms) == count + is_sent
    assert node.transforms[-1].transform == node.transforms[-2].transform
    for message, k in zip(published, used, strict=True):
        stamp = message.header.stamp
        assert message.header.frame_id == "map" and stamp.sec * 10**9 + stamp.nanosec == stamp_ns(exposures[k])
        at, q = message.pose.pose.position, message.pose.pose.orientation
        found_m = np.array([at.x, at.y, at.z])
        np.testing.assert_allclose(found_m, track.filtered.position_enu_m[k], rtol=0, atol=TOLERANCE_M)
        covariance = message.pose.covariance.reshape(6, 6)
        np.testing.assert_allclose(covariance[:2, :2], track.filtered.covariance_m2[k], rtol=1e-4)
        assert (np.diag(covariance)[2:] == 1e6).all() and np.count_nonzero(covariance) == 8
        assert np.linalg.norm(found_m[:2] - truth.position_m[k, :2]) < 2.0 * track.filtered.radius999_m[k]
        # Both turn from the body to enu: the true pose of TUM text, and a ROS pose.
        R_enu_body = R_from_quat_xyzw([q.x, q.y, q.z, q.w])
        np.testing.assert_allclose(R_enu_body, R_from_quat_xyzw(truth.quat_xyzw[k]), atol=2e-3)


def test_messages_that_cannot_be_used_are_named_and_publish_nothing(drive, node):
    _, exposures, odometry, _ = drive
    moves, lines = odometry_messages(odometry), node.logger.lines
    image = image_message(stamp_ns(exposures[0]), exposures[0].pixels_adu)
    node.callbacks["image"](image)  # before any odometry
    node.callbacks["odom"](moves[0])
    node.callbacks["odom"](moves[0])
    image.encoding = "rgb8"
    node.callbacks["image"](image)
    node.callbacks["odom"](moves[1])
    assert [kind for kind, _ in lines] == ["warning", "warning", "error"]
    for (_, text), words in zip(lines, ("earlier than the odometry", "not later than", "encoding 'rgb8'"), strict=True):
        assert words in text
    assert node.publishers["pose"].messages == []
    assert node.transforms == []


def test_a_message_without_time_is_refused(drive):
    message = stamped(image_message(0, np.zeros((8, 8))), 0)
    with pytest.raises(BadInput, match="image-7: a message's header has no time") as refusal:
        exposure_of_message(message, "image-7")
    assert refusal.value.reason == "bad_image"
