from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from companion.config import Config, DistributedConfig
from companion.daemon.nodes.node_config import with_stages
from companion.errors import InputError
from companion.geometry.transforms import Pose
from companion.messages import MapUpdate, Odometry, TrackState, Warned
from companion.stages.topics_work import MALFORMED
from companion.topics.envelope import Envelope, unpack
from companion.topics.keyframe_bundle import bundle_of
from drivers.system.zenoh_bus import ZenohBus
from tests.support.flights import topic_flight
from tests.support.processes.zenoh_nodes import (
    Ground,
    drone_config,
    free_endpoint,
    ground_config,
    joined_config,
    topics_of,
)

DOCUMENT = Path(__file__).parents[3] / "docs" / "topics.md"
WAIT_S = 20.0


@pytest.fixture
def closing() -> Iterator[ExitStack]:
    """Closes what a test has opened, however it ends."""
    with ExitStack() as stack:
        yield stack


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


def test_what_is_malformed_is_refused_by_both_sides(
    tmp_path: Path, closing: ExitStack, capfd: pytest.CaptureFixture[str]
) -> None:
    endpoint = free_endpoint()
    drone = closing.enter_context(topics_of(endpoint, tmp_path))
    bus = ZenohBus(joined_config(endpoint))
    closing.callback(bus.close)
    run = asked(bus, "flight").text("run")
    for message in topic_flight.messages(20):
        drone.step(message)
    for bad in (b"", b"\xff" * 40, wanted(run, 1)[:-2], Envelope("wanted", {"run": 3}, {}).pack()):
        assert bus.ask("depth_input", bad, 0.5) is None
    given = drone.step(topic_flight.frame(21, topic_flight.wall()))
    said = [(m.what, m.detail) for m in given if isinstance(m, Warned) and m.detail]
    assert said == [(MALFORMED, "4 so far")]
    assert bundle_of(asked(bus, "depth_input", wanted(run, 0))).number == 1

    other = free_endpoint()
    bad_drone = ZenohBus(drone_config(other))
    closing.callback(bad_drone.close)
    about = unpack(drone.about)
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
    asked_on = threading.Event()

    def reply(data: bytes) -> bytes:
        if not replies:
            asked_on.set()  # whoever asks again has dealt with the last reply
        return replies.pop(0) if replies else b""

    bad_drone.serve("depth_input", reply)
    ground = Ground(ground_config(other, tmp_path))
    closing.callback(ground.stop)
    assert asked_on.wait(30)
    ground.stop()  # raises what brought it down
    assert not replies and "malformed" in capfd.readouterr().err
    assert [p.name for p in (tmp_path / "ground").iterdir()] == ["drone-a-flight"]


def test_the_subscriber_of_the_documentation_works(tmp_path: Path, closing: ExitStack) -> None:
    code = re.search(r"```python\n(.*?)```", DOCUMENT.read_text("utf-8"), re.DOTALL)
    assert code is not None and len(code[1].splitlines()) <= 18
    endpoint = free_endpoint()
    drone = closing.enter_context(topics_of(endpoint, tmp_path))
    reader = subprocess.Popen(
        [sys.executable, "-c", code[1], endpoint], stdout=subprocess.PIPE, text=True
    )
    try:
        assert reader.stdout is not None
        until_s = time.monotonic() + WAIT_S
        has_subscribers = drone.bus.has_subscribers
        while not has_subscribers("pose") and time.monotonic() < until_s:
            time.sleep(0.05)
        drone.step(Odometry(1, 17, TrackState.TRACKING, 0, 50, Pose.identity(), np.zeros(3)))
        for message in topic_flight.messages(8):
            drone.step(message)
        lines = [reader.stdout.readline() for _ in range(4)]
    finally:
        reader.kill()
        reader.communicate()
    assert lines[0] == "pose 17 {}\n"
    assert [line.split()[0] for line in lines[1:]] == ["keyframe", "map", "keyframe"]
    assert "'points_camera': (60, 3)" in lines[1]


def test_the_map_can_be_asked_for(tmp_path: Path, closing: ExitStack) -> None:
    endpoint = free_endpoint()
    drone = closing.enter_context(topics_of(endpoint, tmp_path))
    bus = ZenohBus(joined_config(endpoint))
    closing.callback(bus.close)
    assert asked(bus, "flight").part("camera").integer("width") == 128
    assert bus.ask("map", b"", 0.5) is None
    update = topic_flight.update(12)
    assert isinstance(update, MapUpdate)
    drone.step(update)
    assert len(asked(bus, "map").array("ids", "<i4", -1)) == 3


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
    monkeypatch.setattr("drivers.system.zenoh_bus.LISTEN_MS", 100)
    with pytest.raises(InputError, match=re.escape(said)):
        ZenohBus(distributed)


def test_without_zenoh_no_flight_begins(tmp_path: Path) -> None:
    hidden, flights = tmp_path / "hidden", tmp_path / "flights"
    hidden.mkdir()
    (hidden / "zenoh.py").write_text("raise ImportError\n", "utf-8")
    command = [sys.executable, "-m", "companion", "run", "--stages", "tracking"]
    ended = subprocess.run(
        [*command, "--set", f"daemon.flights={flights}", "--set", "camera.source=pattern"],
        env=os.environ | {"PYTHONPATH": str(hidden)}, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert ended.returncode == 2 and not flights.exists()
    assert "needs Zenoh: pip install" in ended.stderr


def test_options_say_what_runs_where() -> None:
    drone = with_stages(Config(), ("tracking",), []).distributed
    assert drone.enabled and drone.stages == ("tracking",)
    ground = with_stages(Config(), ("cloud", "depth"), ["tcp/h:1"]).distributed
    assert ground.connect == ("tcp/h:1",)
    assert not with_stages(Config(), None, []).distributed.enabled
    for stages, join in ((("depth",), ["tcp/h:1"]), (("depth", "cloud"), []), (("fly",), [])):
        with pytest.raises(InputError):
            with_stages(Config(), stages, join)
