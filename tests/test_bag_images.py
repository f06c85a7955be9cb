"""Images of ROS bags through `locate` and `batch`: as if they were files."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="the extra `ros` is not installed")
from bag_helpers import FORMATS, STAMP, STAMP_NS, write_bag
from hazard_helpers import rendered, small_camera

from startrack.camera import save_camera
from startrack.cli.main import main
from startrack.core.types import BadInput, Exposure
from startrack.exposure import (
    choose_bag_image,
    list_bag_images,
    read_bag_exposures,
    read_bag_image,
    split_bag_path,
    write_exposure,
)

PIXELS = [np.random.default_rng(k).normal(100.0, 3.0, (64, 96)).round().astype(np.uint16) for k in range(5)]


def noise_topics(messages: Any) -> list[Any]:
    """Two topics of frames without stars."""
    left = [("/left", messages.image(STAMP_NS + k * 10**9, PIXELS[k], "mono16")) for k in range(4)]
    return [*left, ("/right", messages.image(STAMP_NS, PIXELS[4], "mono16"))]


@pytest.fixture(scope="module")
def known() -> Exposure:
    """An image whose sky is that of the whole catalogue, which the commands use."""
    return rendered(faintest_v_mag=np.inf)


@pytest.fixture(scope="module")
def drive(known, tmp_path_factory) -> Path:
    """A bag with two exposures of one scene, a frame without stars and one of another encoding."""
    folder = tmp_path_factory.mktemp("drive")
    save_camera(small_camera(), folder / "camera.toml")
    pixels = np.asarray(known.pixels_adu).astype(np.uint16)
    start = int(known.time_utc.timestamp()) * 10**9

    def topics(messages: Any) -> list[Any]:
        return [
            ("/cam", messages.image(start, pixels, "mono16")),
            ("/cam", messages.image(start + 10**9, pixels[::-1], "rgb8")),
            ("/cam", messages.image(start + 2 * 10**9, np.full_like(pixels, 300), "mono16")),
            ("/cam/small", messages.image(start, PIXELS[0], "mono16")),
        ]

    write_exposure(folder / "same.png", replace(known, camera=None, terrain=None))
    return write_bag(folder, "ros2.mcap", topics)


def flags(drive: Path, out: Path, known: Exposure) -> list[str]:
    camera, seconds = str(drive.parent.parent / "camera.toml"), str(known.exposure_s)
    return ["-c", camera, "-t", "shackleton-thesis", "--exposure", seconds, "-D", str(out), "--no-plots"]


@pytest.mark.parametrize("log_step_ns", [1, 0])  # 0: all messages are recorded at one time
@pytest.mark.parametrize("form", FORMATS)
def test_each_image_is_read_alone_as_it_is_read_in_turn(tmp_path, form, log_step_ns):
    path = write_bag(tmp_path, form, noise_topics, log_step_ns)
    listed = list_bag_images(path, "/left")
    assert [Path(one.path).name for one in listed] == [f"{path.name}#{k:06d}" for k in range(4)]
    for image, exposure in zip(listed[::-1], list(read_bag_exposures(path, "/left"))[::-1], strict=True):
        alone = read_bag_image(image, exposure_s=2.0)
        np.testing.assert_array_equal(alone.pixels_adu, exposure.pixels_adu)
        assert (alone.time_utc, alone.sha256) == (exposure.time_utc, exposure.sha256)
        assert (alone.sha256, alone.exposure_s) == (image.message.sha256, 2.0)
    assert read_bag_image(listed[3]).time_utc == STAMP + timedelta(seconds=3)
    with pytest.raises(BadInput, match="has changed since"):
        read_bag_image(replace(listed[0], message=listed[1].message._replace(sha256="0")))


def test_a_number_chooses_an_image(tmp_path):
    path = write_bag(tmp_path, "ros1.bag", noise_topics)
    assert split_bag_path(str(path)) == (str(path), None)
    assert split_bag_path(f"{path}#2") == split_bag_path(f"{path}#000002") == (str(path), 2)
    assert split_bag_path("night#2.png") is split_bag_path("frame.png") is split_bag_path(str(tmp_path)) is None
    np.testing.assert_array_equal(read_bag_image(choose_bag_image(path, 2, "/left")).pixels_adu, PIXELS[2])
    np.testing.assert_array_equal(read_bag_image(choose_bag_image(path, None, "/right")).pixels_adu, PIXELS[4])
    for number, topic, words in (
        (None, "/left", "holds 4 images: choose one, .*ros1.bag#0 to .*ros1.bag#3, or locate all with startrack batch"),
        (4, "/left", "has no image 4: it holds 4, from 0"),
        (0, None, "several topics of type .*choose one with --image-topic: /left, /right"),
        (0, "/none", "no topic /none"),
    ):
        with pytest.raises(BadInput, match=words) as refusal:
            choose_bag_image(path, number, topic)
        assert refusal.value.reason == "bad_image"
    with pytest.raises(BadInput, match="no such file"):
        choose_bag_image(tmp_path / "none.mcap", 0)


def test_locate_gives_the_fix_of_the_same_image_in_a_file(drive, known, tmp_path, capsys):
    common = flags(drive, tmp_path, known)
    records = []
    time = known.time_utc.isoformat()
    for command in (
        ["locate", f"{drive}#0", "--image-topic", "/cam", *common, "--json", "--time-sigma", "1"],
        ["locate", str(drive.parent.parent / "same.png"), *common, "--json", "--time", time, "--time-sigma", "1"],
    ):
        assert main(command) == 0
        records.append(json.loads(capsys.readouterr().out))
    assert records[0]["image"] == f"{drive.name}#000000"
    assert records[0]["position"] == records[1]["position"]
    assert records[0]["provenance"]["time_utc"] == records[1]["provenance"]["time_utc"]
    assert main(["locate", str(drive), "--image-topic", "/cam", *common]) == 4
    assert "holds 3 images: choose one" in capsys.readouterr().out
    with pytest.raises(SystemExit) as usage:
        main(["locate", str(drive.parent.parent / "same.png"), "--image-topic", "/cam", *common])
    assert usage.value.code == 2


@pytest.mark.slow
def test_a_batch_of_a_bag_is_resumed(drive, known, tmp_path, capsys):
    command = ["batch", str(drive), "--image-topic", "/cam", *flags(drive, tmp_path, known), "-j", "1", "--json"]
    assert main(command) == 5
    first = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    by_name = {record["image"]: record for record in first}
    assert sorted(by_name) == [f"{drive.name}#{number:06d}" for number in range(3)]
    assert [by_name[name]["status"] for name in sorted(by_name)] == ["ok", "refused", "refused"]
    assert [by_name[name]["reason"] for name in sorted(by_name)] == [None, "bad_image", "no_stars"]
    assert "encoding 'rgb8'" in by_name[f"{drive.name}#000001"]["message"]
    results = sorted(tmp_path.glob("*.fix.json"))
    assert [path.name for path in results] == [f"{drive.stem}-{number:06d}.fix.json" for number in range(3)]
    stamps = [path.stat().st_mtime_ns for path in results]
    tables = [(tmp_path / name).read_bytes() for name in ("results.ecsv", "trajectory.tum", "manifest.json")]
    results[2].unlink()
    assert main(command) == 5
    assert [path.stat().st_mtime_ns for path in results[:2]] == stamps[:2]  # kept
    assert results[2].exists()
    assert [(tmp_path / name).read_bytes() for name in ("results.ecsv", "trajectory.tum", "manifest.json")] == tables


@pytest.mark.parametrize(
    ("more", "words"),
    [(["--time", "2030-01-01T00:00:00Z"], "the times of their messages"), (["--files-on-stdin"], "is a ROS bag")],
)
def test_flags_of_folders_are_wrong_usage_for_a_bag(drive, tmp_path, capsys, more, words):
    with pytest.raises(SystemExit) as usage:
        main(["batch", str(drive), "--image-topic", "/cam", "-D", str(tmp_path), *more])
    assert usage.value.code == 2
    assert words in capsys.readouterr().err


def test_a_topic_is_wrong_usage_for_a_folder(tmp_path, capsys):
    with pytest.raises(SystemExit) as usage:
        main(["batch", str(tmp_path), "--image-topic", "/cam", "-D", str(tmp_path / "out")])
    assert usage.value.code == 2
    assert "--image-topic is for a ROS bag" in capsys.readouterr().err


def test_without_rosbags_the_extra_is_named(drive, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("startrack.exposure.bag.find_spec", lambda name: None)
    assert main(["batch", str(drive), "-D", str(tmp_path)]) == 4
    assert "pip install '.[ros]'" in capsys.readouterr().err


def test_no_room_is_made_for_more_than_a_bag_holds(tmp_path):
    """The first record of an MCAP file's summary states a length of 1 TB."""
    bag = write_bag(tmp_path, "ros2.mcap", noise_topics)
    data = bytearray(bag.read_bytes())
    (summary,) = struct.unpack_from("<Q", data, len(data) - 37 + 9)  # of the footer
    struct.pack_into("<Q", data, summary + 1, 2**40)
    bag.write_bytes(data)
    with pytest.raises(
        BadInput, match=r"damaged or unknown ROS bag \((a length in it is beyond its end|.*Truncated record)"
    ):
        list_bag_images(bag)


def test_a_large_description_of_a_bag_is_refused(tmp_path):
    bag = write_bag(tmp_path, "ros2-folder", noise_topics)
    with (bag / "metadata.yaml").open("a") as file:
        file.write(2**20 * "[")
    with pytest.raises(BadInput, match=r"its metadata\.yaml has more than 1 MiB"):
        list_bag_images(bag)
