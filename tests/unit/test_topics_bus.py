from __future__ import annotations

import re
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from companion.config import Config, DaemonConfig, DistributedConfig, StreamConfig
from companion.errors import InputError
from companion.geometry import Pose
from companion.live.depth_node import DepthNode
from companion.live.nodes import with_stages
from companion.messages import MapUpdate, Odometry, TrackState
from companion.stages.protocol import Finish
from companion.topics.bundle import bundle_of
from companion.topics.envelope import Envelope, unpack
from drivers.zenoh_bus import ZenohBus
from tests.support import topic_flight
from tests.support.bus import drone_config, free_endpoint, joined_config, topics_of

DOCUMENT = Path(__file__).parents[2] / "docs" / "topics.md"
WAIT_S = 20.0


def ground_config(endpoint: str, folder: Path) -> Config:
    return replace(
        Config(), distributed=joined_config(endpoint), stream=StreamConfig(listen=""),
        daemon=DaemonConfig(flights=str(folder / "ground")),
    )  # fmt: skip


class Ground:
    """A node with depth and cloud, in a thread."""

    def __init__(self, config: Config) -> None:
        self._over = threading.Event()
        self._node = DepthNode(config, self._over.is_set)
        self._fault: BaseException | None = None
        self._thread = threading.Thread(target=self._work)
        self._thread.start()

    def stop(self) -> None:
        self._over.set()
        self._thread.join(60)
        self._node.close()
        if self._fault is not None:
            raise self._fault

    def _work(self) -> None:
        try:
            self._node.run()
        except BaseException as fault:
            self._fault = fault


def wanted(run: str, after: int) -> bytes:
    return Envelope("wanted", {"run": run, "after": after, "whole": False}, {}).pack()


def asked(bus: ZenohBus, topic: str, data: bytes = b"") -> Envelope:
    """An answer, once nodes have found each other."""
    until_s = time.monotonic() + WAIT_S
    while time.monotonic() < until_s:
        answer = bus.ask(topic, data, 5.0)
        if answer is not None:
            return unpack(answer)
        time.sleep(0.05)
    raise AssertionError(f"nobody answers {topic}")


def points_in(folder: Path) -> int:
    head = (folder / "cloud.ply").read_bytes()[:600].decode("ascii", "ignore")
    found = re.search(r"element vertex (\d+)", head)
    assert found is not None
    return int(found[1])


def test_the_node_makes_the_map_of_a_flight_and_goes_on_after_a_restart(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    messages = list(topic_flight.messages(130))
    first = Ground(ground_config(endpoint, tmp_path))  # before the drone is there
    drone = topics_of(endpoint, tmp_path)
    for message in messages[: len(messages) // 2]:
        drone.step(message)
    folder = tmp_path / "ground" / "drone-a-flight"
    kept = folder / "cloud.chunks"
    until_s = time.monotonic() + 60
    while not (kept.exists() and kept.stat().st_size > 2000) and time.monotonic() < until_s:
        time.sleep(0.1)
    first.stop()
    n_first, n_kept = points_in(folder), kept.stat().st_size
    assert n_first > 50
    for message in messages[len(messages) // 2 :]:
        drone.step(message)  # nobody is there, and it takes no notice
    second = Ground(ground_config(endpoint, tmp_path))
    drone.finish(Finish(hurry=False))  # waits for who fetches
    second.stop()
    assert points_in(folder) > 1.3 * n_first
    assert kept.stat().st_size > n_kept


def test_what_is_malformed_is_refused_by_both_sides(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    endpoint = free_endpoint()
    drone = topics_of(endpoint, tmp_path)
    bus = ZenohBus(joined_config(endpoint))
    run = asked(bus, "flight").text("run")
    for message in topic_flight.messages(20):
        drone.step(message)
    for bad in (b"", b"\xff" * 40, wanted(run, 1)[:-2], Envelope("wanted", {"run": 3}, {}).pack()):
        assert bus.ask("depth_input", bad, 0.5) is None
    assert bundle_of(asked(bus, "depth_input", wanted(run, 0))).number == 1
    bus.close()
    drone.finish(Finish(hurry=True))

    other = free_endpoint()
    bad_drone = ZenohBus(drone_config(other))
    about = unpack(drone._about)  # type: ignore[attr-defined]
    answers = [b"junk", about.pack().replace(b"a-flight", b"../a/b/c"), about.pack()]
    bad_drone.serve("flight", lambda data: answers.pop(0) if len(answers) > 1 else answers[0])
    bundles = [b.pack() for b in topic_flight.bundles(20, run=about.text("run"))]
    replies = [
        b"",
        bundles[0][:-5],
        b"\x00" * 100,
        *bundles[:2],
        bundles[2].replace(b"\xff\xd8", b"\0\0"),
    ]
    bad_drone.serve("depth_input", lambda data: replies.pop(0) if replies else b"")
    ground = Ground(ground_config(other, tmp_path))
    until_s = time.monotonic() + 30
    while replies and time.monotonic() < until_s:
        time.sleep(0.05)
    time.sleep(0.3)
    ground.stop()  # raises what brought it down
    bad_drone.close()
    assert not replies and "malformed" in capfd.readouterr().err
    assert [p.name for p in (tmp_path / "ground").iterdir()] == ["drone-a-flight"]


def test_the_subscriber_of_the_documentation_works(tmp_path: Path) -> None:
    code = re.search(r"```python\n(.*?)```", DOCUMENT.read_text("utf-8"), re.DOTALL)
    assert code is not None and len(code[1].splitlines()) <= 18
    endpoint = free_endpoint()
    drone = topics_of(endpoint, tmp_path)
    reader = subprocess.Popen(
        [sys.executable, "-c", code[1], endpoint], stdout=subprocess.PIPE, text=True
    )
    try:
        assert reader.stdout is not None
        until_s = time.monotonic() + WAIT_S
        is_wanted = drone._bus.is_wanted  # type: ignore[attr-defined]
        while not is_wanted("pose") and time.monotonic() < until_s:
            time.sleep(0.05)
        drone.step(Odometry(1, 17, TrackState.TRACKING, 0, 50, Pose.identity(), np.zeros(3)))
        for message in topic_flight.messages(8):
            drone.step(message)
        lines = [reader.stdout.readline() for _ in range(4)]
    finally:
        reader.kill()
        reader.communicate()
        drone.finish(Finish(hurry=True))
    assert lines[0] == "pose 17 {}\n"
    assert [line.split()[0] for line in lines[1:]] == ["keyframe", "map", "keyframe"]
    assert "'points_camera': (60, 3)" in lines[1]


def test_the_map_can_be_asked_for(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    drone = topics_of(endpoint, tmp_path)
    bus = ZenohBus(joined_config(endpoint))
    assert asked(bus, "flight").part("camera").integer("width") == 128
    assert bus.ask("map", b"", 0.5) is None
    update = topic_flight.update(12)
    assert isinstance(update, MapUpdate)
    drone.step(update)
    assert len(asked(bus, "map").array("ids", "<i4", -1)) == 3
    bus.close()
    drone.finish(Finish(hurry=True))


@pytest.mark.parametrize(
    ("distributed", "said"),
    [
        (DistributedConfig(vehicle="a/b"), "vehicle"),
        (DistributedConfig(listen=("7447",)), "listen"),
        (DistributedConfig(connect=("here",)), "connect"),
        (DistributedConfig(listen=("tcp/192.0.2.7:7447",)), "192.0.2.7"),
    ],
)
def test_what_cannot_be_had_is_named(
    distributed: DistributedConfig, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.zenoh_bus.LISTEN_MS", 100)
    with pytest.raises(InputError, match=re.escape(said)):
        ZenohBus(distributed)


def test_options_say_what_runs_where() -> None:
    drone = with_stages(Config(), ("tracking",), []).distributed
    assert drone.enabled and drone.stages == ("tracking",)
    ground = with_stages(Config(), ("cloud", "depth"), ["tcp/h:1"]).distributed
    assert ground.connect == ("tcp/h:1",)
    assert not with_stages(Config(), None, []).distributed.enabled
    for stages, join in ((("depth",), ["tcp/h:1"]), (("depth", "cloud"), []), (("fly",), [])):
        with pytest.raises(InputError):
            with_stages(Config(), stages, join)
