"""Topics for ROS 2: what a node of rmw_zenoh would subscribe to, read by ROS's own definitions."""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from rosbags.typesys import Stores, get_typestore

from companion.errors import InputError
from companion.geometry.transforms import Pose, yaw_rotation
from companion.messages import Odometry, PointChunk, TrackState
from companion.stages.topics_work import Topics
from drivers.system.ros_messages import POINT
from tests.support.flights import topic_flight
from tests.support.processes.zenoh_nodes import free_endpoint, topics_of
from tests.support.waiting import until

JAZZY = get_typestore(Stores.ROS2_JAZZY)
KINDS = {
    "odometry": "nav_msgs/msg/Odometry", "image/compressed": "sensor_msgs/msg/CompressedImage",
    "points": "sensor_msgs/msg/PointCloud2",
}  # fmt: skip


class RosNode:
    """A session with what came, by topic: key, number, message."""

    def __init__(self, endpoint: str) -> None:
        settings = zenoh.Config()
        settings.insert_json5("mode", '"client"')
        settings.insert_json5("connect/endpoints", f'["{endpoint}"]')
        self.session = zenoh.open(settings)
        self.came: dict[str, list[tuple[str, int, Any]]] = {}
        self._lock = threading.Lock()

    def subscribe(self, topic: str) -> None:
        kind = KINDS[topic]
        package, _, name = kind.split("/")
        typed = f"{package}::msg::dds_::{name}_/{JAZZY.hash_rihs01(kind)}"

        def take(sample: zenoh.Sample) -> None:
            attachment = sample.attachment.to_bytes() if sample.attachment is not None else b""
            number, stamp, size = struct.unpack("<qqB", attachment[:17])
            assert size == 16 and len(attachment) == 33 and stamp > 0
            message = JAZZY.deserialize_cdr(sample.payload.to_bytes(), kind)
            with self._lock:
                self.came.setdefault(topic, []).append((str(sample.key_expr), number, message))

        self.session.declare_subscriber(f"7/companion/drone/{topic}/{typed}", take)


@pytest.fixture
def closing() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def drone(tmp_path: Path, closing: ExitStack) -> tuple[Topics, RosNode]:
    """A stage of topics for ROS domain 7, and a node that listens to all three."""
    endpoint = free_endpoint()
    stage = closing.enter_context(topics_of(endpoint, tmp_path, ros_domain=7))
    node = RosNode(endpoint)
    closing.callback(node.session.close)
    for topic in KINDS:
        node.subscribe(topic)
    for topic in KINDS:
        until(lambda topic=topic: stage.bus.has_subscribers(f"ros/{topic}"), topic)  # type: ignore[misc]
    return stage, node


def test_a_pose_is_east_north_up_and_forward_left_up(drone: tuple[Topics, RosNode]) -> None:
    stage, node = drone
    pose = Pose(yaw_rotation(np.pi / 2), np.array([1.0, 2.0, -3.0]))  # its nose to the east
    odometry = Odometry(
        1, 5_000_000_007, TrackState.TRACKING, 0, 90, pose, np.array([0.0, 4.0, -1.0]), 0.5, 0.1,
        0.02, 0.03,
    )  # fmt: skip
    stage.step(odometry)
    stage.step(replace(odometry, world_from_body=None))
    stage.step(replace(odometry, t_ns=6_000_000_000))
    until(lambda: len(node.came.get("odometry", ())) == 2, "both poses came")
    (_, first, told), (_, second, _) = node.came["odometry"]
    assert (first, second) == (1, 2)
    assert (told.header.stamp.sec, told.header.stamp.nanosec) == (5, 7)
    assert (told.header.frame_id, told.child_frame_id) == ("map", "base_link")
    place, turn = told.pose.pose.position, told.pose.pose.orientation
    assert [place.x, place.y, place.z] == [2.0, 1.0, 3.0]
    # forward is east: no rotation is left, of either sign
    assert abs(turn.w) == pytest.approx(1.0) and turn.z == pytest.approx(0.0, abs=1e-9)
    speed = told.twist.twist.linear
    assert [speed.x, speed.y, speed.z] == pytest.approx([4.0, 0.0, 1.0])
    sigmas = np.sqrt(told.pose.covariance.reshape(6, 6).diagonal())
    assert sigmas == pytest.approx([0.5, 0.5, 0.5, 0.02, 0.02, 0.03])


def test_points_lie_in_the_world_and_pictures_are_jpeg(drone: tuple[Topics, RosNode]) -> None:
    stage, node = drone
    for message in topic_flight.messages(8):
        stage.step(message)
    points = np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 1.0]], np.float32)
    chunk = PointChunk(
        1, topic_flight.START_NS, points, np.array([[255, 2, 1], [0, 0, 9]], np.uint8),
        np.ones(2, np.float32), np.zeros((2, 3), np.float32), np.ones(2, np.float32),
    )  # fmt: skip
    stage.step(chunk)
    until(lambda: {"points", "image/compressed"} <= set(node.came), "points and pictures came")
    cloud = node.came["points"][0][2]
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "rgb"]
    found = cloud.data.view(POINT)
    assert [hex(each) for each in found["rgb"]] == ["0xff0201", "0x9"]
    keyframe = topic_flight.pose(topic_flight.PER_KEYFRAME).translation
    ned = topic_flight.METRES_PER_UNIT * (points + keyframe) + [10.0, 20.0, -30.0]
    np.testing.assert_allclose(found["xyz"], ned[:, [1, 0, 2]] * [1, 1, -1], rtol=1e-6)
    image = node.came["image/compressed"][0][2]
    assert image.format == "jpeg" and image.data[:2].tobytes() == b"\xff\xd8"


def test_the_graph_of_ros_knows_them(drone: tuple[Topics, RosNode]) -> None:
    _, node = drone
    tokens = [
        str(each.ok.key_expr)
        for each in node.session.liveliness().get("@ros2_lv/7/**")
        if each.ok is not None
    ]
    assert len(tokens) == 4 and any(each.endswith("/NN/%/%/companion") for each in tokens)
    ends = [each.split("/MP/%/%/companion/")[1] for each in tokens if "/MP/" in each]
    assert {each.split("/")[0] for each in ends} == {
        "%companion%drone%odometry", "%companion%drone%points",
        "%companion%drone%image%compressed",
    }  # fmt: skip


def test_a_name_that_ros_would_refuse_is_said(tmp_path: Path) -> None:
    with (
        pytest.raises(InputError, match="letters, digits and _"),
        topics_of(free_endpoint(), tmp_path, ros_domain=0, vehicle="drone-1"),
    ):
        pass
