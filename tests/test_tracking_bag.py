"""Odometry and images from ROS bags: real bags of all formats are written with rosbags and read back."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from startrack.applications.tracking import read_bag_exposures, read_odometry
from startrack.core.errors import BadInput
from startrack.exposure import read_exposure

pytest.importorskip("rosbags", reason="the extra `ros` is not installed")
from bag_helpers import FORMATS, STAMP, STAMP_NS, write_bag

RNG = np.random.default_rng(3)
POSES = np.column_stack([RNG.normal(0, 5, (6, 3)), Rotation.random(6, random_state=RNG).as_quat()])
PIXELS = RNG.integers(0, 60_000, (6, 10)).astype(np.uint16)


def odometry_topics(messages, topic="/odom"):
    return [(topic, messages.odometry(STAMP_NS + k * 10**9, pose)) for k, pose in enumerate(POSES)]


@pytest.mark.parametrize("form", FORMATS)
def test_odometry_of_every_kind_of_bag(tmp_path, form):
    path = write_bag(tmp_path, form, odometry_topics)
    odometry = read_odometry(path)
    np.testing.assert_allclose(odometry.time_s, STAMP.timestamp() + np.arange(6), atol=1e-6)
    np.testing.assert_array_equal(np.column_stack([odometry.position_m, odometry.quat_xyzw]), POSES)
    again = read_odometry(path, topic="/odom")
    np.testing.assert_array_equal(again.position_m, odometry.position_m)


def test_poses_are_sorted_by_the_times_of_their_headers(tmp_path):
    path = write_bag(tmp_path, "ros2.mcap", lambda messages: odometry_topics(messages)[::-1])
    np.testing.assert_array_equal(read_odometry(path).position_m, POSES[:, :3])


@pytest.mark.parametrize("form", FORMATS)
def test_of_several_topics_one_must_be_chosen(tmp_path, form):
    def topics(messages):
        shifted = messages.odometry(STAMP_NS, POSES[0] + [9, 0, 0, 0, 0, 0, 0])
        wheel = [("/wheel", shifted), ("/wheel", messages.odometry(STAMP_NS + 10**9, POSES[1]))]
        return [*odometry_topics(messages), *wheel, ("/cam", messages.image(STAMP_NS, PIXELS, "mono16"))]

    path = write_bag(tmp_path, form, topics)
    with pytest.raises(BadInput, match=r"several topics of type nav_msgs/Odometry: .*--odometry-topic: /odom, /wheel"):
        read_odometry(path)
    assert len(read_odometry(path, topic="/wheel").time_s) == 2
    with pytest.raises(BadInput, match=r"no topic /cam of type nav_msgs/Odometry; .* /odom, /wheel"):
        read_odometry(path, topic="/cam")
    assert len(list(read_bag_exposures(path))) == 1  # its only image topic


@pytest.mark.parametrize("form", FORMATS)
def test_images_of_every_kind_of_bag(tmp_path, form):
    eight = (PIXELS >> 8).astype(np.uint8)
    png, jpeg = (cv2.imencode(end, pixels)[1].tobytes() for end, pixels in ((".png", PIXELS), (".jpg", eight)))

    def topics(messages):
        at = [STAMP_NS + k * 10**9 for k in range(4)]
        return [
            ("/cam", messages.image(at[0], PIXELS, "mono16", padding=6)),
            ("/cam", messages.image(at[1], PIXELS, "mono16", big_endian=True)),
            ("/cam", messages.image(at[2], eight, "mono8", padding=1)),
            ("/cam/compressed", messages.compressed(at[0], png, "mono16; png compressed mono16")),
            ("/cam/compressed", messages.compressed(at[1], jpeg, "jpeg")),
        ]

    path = write_bag(tmp_path, form, topics)
    with pytest.raises(BadInput, match="--image-topic: /cam, /cam/compressed") as refusal:
        list(read_bag_exposures(path))
    assert refusal.value.reason == "bad_image"
    little, big, byte = read_bag_exposures(path, "/cam", camera="fisheye-2048", exposure_s=2.0, time_sigma_s=5.0)
    np.testing.assert_array_equal(little.pixels_adu, PIXELS)
    np.testing.assert_array_equal(big.pixels_adu, PIXELS)
    np.testing.assert_array_equal(byte.pixels_adu, eight)
    assert (little.saturation_adu, byte.saturation_adu) == (65535, 255)
    assert (little.name, byte.name) == (f"{path.stem}-0000", f"{path.stem}-0002")
    assert little.time_utc == STAMP
    assert (byte.time_utc - little.time_utc).total_seconds() == 2
    assert (little.camera, little.exposure_s, little.time_sigma_s, little.path) == ("fisheye-2048", 2, 5, str(path))
    assert len({one.sha256 for one in (little, big, byte)}) == 3
    from_png, from_jpeg = read_bag_exposures(path, "/cam/compressed")
    np.testing.assert_array_equal(from_png.pixels_adu, PIXELS)
    (tmp_path / "same.jpg").write_bytes(jpeg)
    np.testing.assert_array_equal(from_jpeg.pixels_adu, read_exposure(tmp_path / "same.jpg").pixels_adu)


def test_a_bayer_image_is_equalized_as_that_of_a_file_with_the_same_pattern(tmp_path):
    rng = np.random.default_rng(5)
    pixels = rng.poisson(np.tile([[400, 900], [900, 200]], (80, 80))).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), pixels)
    (tmp_path / "a.json").write_text('{"bayer_pattern": "RGGB"}')
    expected = read_exposure(tmp_path / "a.png")
    png = (tmp_path / "a.png").read_bytes()

    def topics(messages):
        return [
            ("/raw", messages.image(STAMP_NS, pixels, "bayer_rggb16")),
            ("/packed", messages.compressed(STAMP_NS, png, "bayer_rggb16; png compressed ")),
        ]

    path = write_bag(tmp_path, "ros1.bag", topics)
    for topic in ("/raw", "/packed"):
        (exposure,) = read_bag_exposures(path, topic)
        np.testing.assert_array_equal(exposure.pixels_adu, expected.pixels_adu)
        assert exposure.warnings == expected.warnings != ()


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"encoding": "rgb8"}, "image 0 of /cam: encoding 'rgb8'; startrack reads mono8"),
        ({"encoding": "32FC1"}, "encoding '32FC1'"),
        ({"width": 11}, "11 x 6 pixels of 2 bytes, 20 bytes a row"),
        ({"height": 7}, "10 x 7 pixels of 2 bytes, 20 bytes a row, in 120 bytes"),
        ({"height": 0}, "holds no pixels"),
        ({"width": 100_000, "height": 100_000}, "200 allowed"),
    ],
)
def test_images_that_cannot_be_used_are_refused(tmp_path, changes, cause):
    def topics(messages):
        return [("/cam", messages.image(STAMP_NS, PIXELS, **{"encoding": "mono16", **changes}))]

    path = write_bag(tmp_path, "ros2.mcap", topics)
    with pytest.raises(BadInput, match=cause) as refusal:
        list(read_bag_exposures(path))
    assert refusal.value.reason == "bad_image"
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("form", FORMATS)
def test_a_damaged_bag_is_refused_in_one_line(tmp_path, form):
    path = write_bag(tmp_path, form, odometry_topics)
    file = path / "metadata.yaml" if path.is_dir() else path
    raw = file.read_bytes()
    for damaged in (b"", raw[: len(raw) // 3], b"\0" * len(raw)):
        file.write_bytes(damaged)
        with pytest.raises(BadInput) as refusal:
            read_odometry(path)
        assert refusal.value.reason == "bad_odometry"
        assert str(refusal.value).startswith(f"{path}: ")
        assert "\n" not in str(refusal.value)


def test_bags_without_usable_odometry_are_refused(tmp_path):
    cases = {
        "header has no time": lambda messages: [("/odom", messages.odometry(0, POSES[0]))],
        "several frames": lambda messages: [
            ("/odom", messages.odometry(STAMP_NS + k, POSES[k], child=name)) for k, name in enumerate(("base", "arm"))
        ],
        "no topic of type nav_msgs/Odometry": lambda messages: [("/cam", messages.image(STAMP_NS, PIXELS, "mono16"))],
        "a second pose": lambda messages: [("/odom", messages.odometry(STAMP_NS, POSES[k])) for k in (0, 1)],
        "1 pose": lambda messages: odometry_topics(messages)[:1],
        "pose 1: the quaternion": lambda messages: [
            ("/odom", messages.odometry(STAMP_NS + k, POSES[k] * (1 - k))) for k in (0, 1)
        ],
    }
    for number, (cause, topics) in enumerate(cases.items()):
        (tmp_path / str(number)).mkdir()
        path = write_bag(tmp_path / str(number), "ros1.bag", topics)
        with pytest.raises(BadInput, match=cause) as refusal:
            read_odometry(path)
        assert refusal.value.reason == "bad_odometry"


def test_without_rosbags_a_bag_is_refused_and_text_is_read(tmp_path, monkeypatch):
    path = write_bag(tmp_path, "ros1.bag", odometry_topics)
    (tmp_path / "o.tum").write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    monkeypatch.setattr("startrack.exposure.bag.find_spec", lambda name: None)
    with pytest.raises(BadInput, match=r"rosbags: pip install '\.\[ros\]'"):
        read_odometry(path)
    with pytest.raises(BadInput, match="no such file"):
        read_odometry(tmp_path / "none.tum")
    assert len(read_odometry(tmp_path / "o.tum").time_s) == 2
