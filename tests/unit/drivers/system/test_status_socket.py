"""Status socket on real unix sockets: killed daemons, two daemons, misbehaving clients."""

from __future__ import annotations

import asyncio
import contextlib
import io
import os
import socket
import stat
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from companion.app.cli import READER_GONE
from companion.app.status_command import show_status, status_table
from companion.config import MEASUREMENTS
from companion.dense.device_choice import measured, why_taken
from companion.dense.opencl import ListedDevice
from companion.errors import ConfigError, SourceError
from companion.health import ComputerLoad, FeedbackHealth, Health, SourceHealth, StageHealth
from drivers.system import short_answers
from drivers.system.status_socket import (
    StatusSocket,
    ask_status,
    found_socket_path,
    own_socket_path,
)
from tests.support.processes.closed_pipe import into_closed_pipe
from tests.support.waiting import PATIENCE_S

ROOT = Path(__file__).parents[4]
HEALTH = Health(
    1,
    125.0,
    (SourceHealth("camera", "running", 29.96, 3000, 12, 1, 0.02, "/dev/video0"),),
    (StageHealth("pose", True, 29.9, 31.0, 41.4, 2990),),
    "tracking",
    84,
    "from the autopilot's positions",
    41.4,
    FeedbackHealth("odometry", False, "position too uncertain", "1.31 m"),
    load=ComputerLoad(cpu_share=0.5),
    n_warnings={"frames are missing": 2},
)


@contextlib.asynccontextmanager
async def served(
    path: Path, document: Callable[[], dict[str, Any]] = HEALTH.to_json
) -> AsyncIterator[list[str]]:
    warned: list[str] = []
    server = StatusSocket(path, document, warned.append)
    await server.start()
    try:
        yield warned
    finally:
        await server.stop()


def run(test: Callable[[], Coroutine[Any, Any, None]]) -> None:
    asyncio.run(asyncio.wait_for(test(), PATIENCE_S))


async def ask(path: Path) -> dict[str, Any]:
    return await asyncio.to_thread(ask_status, path)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run" / "status.sock"


async def test_each_connection_gets_the_document_of_its_moment(path: Path) -> None:
    n = 0

    def document() -> dict[str, Any]:
        nonlocal n
        n += 1
        return {"n": n}

    async with served(path, document):
        assert [await ask(path) for _ in range(3)] == [{"n": 1}, {"n": 2}, {"n": 3}]
    assert not path.exists()


async def test_only_owner_and_group_reach_it(path: Path) -> None:
    async with served(path):
        assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
        assert stat.S_IMODE(path.stat().st_mode) == 0o660


@pytest.mark.real_time
async def test_clients_that_never_read_or_never_leave_do_no_harm(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More than the kernel buffers, so that a client which does not read holds its place."""
    monkeypatch.setattr(short_answers, "TIMEOUT_S", 1.0)
    big = {"text": "x" * (1 << 21)}

    async def is_answered() -> bool:
        try:
            return bool(await ask(path) == big)
        except SourceError:
            return False

    async with served(path, lambda: big):
        stuck = []
        for _ in range(short_answers.MAX_CLIENTS):
            client = socket.socket(socket.AF_UNIX)
            client.connect(str(path))
            stuck.append(client)
        while await is_answered():  # until no place is free
            await asyncio.sleep(0.01)
        while not await is_answered():
            await asyncio.sleep(0.1)
        for client in stuck:
            client.close()


async def test_a_client_that_sends_garbage_or_leaves_does_no_harm(path: Path) -> None:
    async with served(path) as warned:
        for garbage in (b"", b"\0" * 100_000, b"GET / HTTP/1.0\r\n\r\n"):
            with socket.socket(socket.AF_UNIX) as client:
                client.connect(str(path))
                client.setblocking(False)
                with contextlib.suppress(OSError):
                    client.send(garbage)
            await asyncio.sleep(0.01)
        assert (await ask(path))["tracker"] == "tracking"
        assert warned == []


async def test_a_fault_in_the_document_is_told_and_survived(
    path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    documents: Iterator[dict[str, Any]] = iter([{"bad": float("nan")}, {"good": 1}])
    async with served(path, lambda: next(documents)) as warned:
        with pytest.raises(SourceError, match="incomplete"):
            await ask(path)
        assert len(warned) == 1
        assert capfd.readouterr().err.count("Traceback") == 1
        assert await ask(path) == {"good": 1}


KILLED = """
import asyncio, os, sys
from pathlib import Path
from drivers.system.status_socket import StatusSocket
async def main():
    await StatusSocket(Path(sys.argv[1]), lambda: {"pid": os.getpid()}, print).start()
    print("up", flush=True)
    await asyncio.sleep(60)
asyncio.run(main())
"""


def test_a_second_daemon_is_refused_and_a_killed_one_replaced(path: Path) -> None:
    daemon = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(path)], cwd=ROOT, stdout=subprocess.PIPE
    )

    async def second() -> None:
        async with served(path):
            pass

    async def replaced() -> None:
        async with served(path):
            assert (await ask(path))["tracker"] == "tracking"

    try:
        assert daemon.stdout is not None
        assert daemon.stdout.readline() == b"up\n"
        with pytest.raises(ConfigError, match="another companion runs here already"):
            run(second)
        assert ask_status(path) == {"pid": daemon.pid}  # the first is none the worse
        daemon.kill()
        daemon.wait()
        assert path.exists()
        with pytest.raises(SourceError, match="no daemon runs"):
            ask_status(path)
        run(replaced)
    finally:
        daemon.kill()
        daemon.wait()
        if daemon.stdout is not None:
            daemon.stdout.close()


def test_what_is_no_socket_is_left_alone(path: Path) -> None:
    path.parent.mkdir()
    path.write_text("precious")

    async def test() -> None:
        with pytest.raises(ConfigError, match="is no socket"):
            async with served(path):
                pass

    run(test)
    assert path.read_text() == "precious"


async def test_places_that_cannot_be_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="longer than 107 bytes"):
        async with served(tmp_path / ("x" * 108)):
            pass
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"expert\.daemon\.socket: .*/file/status\.sock"):
        async with served(tmp_path / "file" / "status.sock"):
            pass
    open_to_all = tmp_path / "open"
    open_to_all.mkdir()
    open_to_all.chmod(0o777)
    with pytest.raises(ConfigError, match="anyone may write there"):
        async with served(open_to_all / "status.sock"):
            pass


def test_the_place_is_found_as_it_is_chosen(tmp_path: Path) -> None:
    assert own_socket_path("/a/b", {}) == Path("/a/b")
    service = {"RUNTIME_DIRECTORY": "/run/x", "XDG_RUNTIME_DIR": str(tmp_path)}
    assert own_socket_path("auto", service) == Path("/run/x/status.sock")
    user = {"XDG_RUNTIME_DIR": str(tmp_path)}
    own = own_socket_path("auto", user)
    assert own == tmp_path / "companion" / "status.sock"
    own.parent.mkdir()
    own.touch()
    assert found_socket_path("auto", user) == own
    assert found_socket_path("/a/b", user) == Path("/a/b")
    assert str(os.getuid()) in str(own_socket_path("auto", {}))
    assert found_socket_path("auto", {}) == Path("/run/companion/status.sock")


def test_table_shows_what_matters() -> None:
    lines = status_table(HEALTH.to_json()).splitlines()
    assert lines[0] == "pose        tracking, quality 84, 41 ms after exposure (p95)"
    assert "feedback    held back: position too uncertain (1.31 m)" in lines
    assert "computer    processor 50 %, memory -, -, disk - free" in lines
    camera = next(line for line in lines if line.startswith("camera"))
    assert camera.split() == [
        "camera", "running", "30.0/s", "3000", "12", "1", "0.0", "s", "ago", "/dev/video0",
    ]  # fmt: skip
    pose = next(line for line in lines if line.startswith("pose") and "runs" in line)
    assert pose.split()[:6] == ["pose", "runs", "29.9/s", "31", "ms", "41"]
    assert lines[-1].split() == ["frames", "are", "missing", "2"]


@pytest.mark.parametrize(
    ("believed", "row"),
    [
        (["attitude", "imu"], "believed    attitude, imu (telemetry.use)"),
        ([], "believed    nothing (telemetry.use)"),
        (MEASUREMENTS, ""),
        ([*MEASUREMENTS, "of another version"], ""),
    ],
)
def test_table_says_what_is_believed_where_it_is_not_everything(
    believed: list[str], row: str
) -> None:
    lines = status_table({**HEALTH.to_json(), "believed": believed}).splitlines()
    assert [line for line in lines if "believed" in line] == ([row] if row else [])


def test_table_says_that_poses_go_by_dead_reckoning() -> None:
    sending = FeedbackHealth("odometry", True, rate_hz=30.0, bridging=True)
    lines = status_table(replace(HEALTH, feedback=sending).to_json()).splitlines()
    assert any(line.startswith("feedback    odometry by dead reckoning, 30/s") for line in lines)
    plain = replace(HEALTH, feedback=replace(sending, bridging=False))
    assert "dead reckoning" not in status_table(plain.to_json())


def test_table_says_what_did_not_fit_the_motion_by_kind() -> None:
    refused = replace(HEALTH, refused={"place": 3, "flow": 12})
    lines = status_table(refused.to_json()).splitlines()
    assert [line for line in lines if "refused" in line] == ["refused     12 of flow, 3 of place"]
    assert not any("refused" in line for line in status_table(HEALTH.to_json()).splitlines())


def test_table_of_a_daemon_of_another_version_is_shown_all_the_same() -> None:
    assert "not known" in status_table({})
    assert "camera" in status_table({"sources": [{"name": "camera"}], "new": 1})


async def test_status_prints_json_or_a_table(path: Path) -> None:
    async def shown(as_json: bool) -> str:
        out = io.StringIO()
        await asyncio.to_thread(
            show_status, path, out, as_json=as_json, watch=False, stop=threading.Event()
        )
        return out.getvalue()

    async with served(path):
        assert '"tracker": "tracking"' in await shown(True)
        assert (await shown(False)).startswith("pose")


def test_watching_ends_when_the_daemon_does(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.app.status_command.WATCH_EVERY_S", 0.02)
    out = io.StringIO()

    async def test() -> None:
        async with served(path):
            watching = asyncio.create_task(
                asyncio.to_thread(
                    show_status, path, out, as_json=True, watch=True, stop=threading.Event()
                )
            )
            while len(out.getvalue().splitlines()) <= 2:
                assert not watching.done()
                await asyncio.sleep(0.005)
        with pytest.raises(SourceError):
            await watching

    run(test)
    assert len(out.getvalue().splitlines()) > 2


def test_a_device_that_is_refused_has_a_line_of_its_own() -> None:
    slow = measured(ListedDevice("0:0", "A", "P"), None, "kernels do not build; 3 errors\nof clang")
    fast = measured(ListedDevice("1:0", "B", "P"), 40.0)
    detail = f"{fast.named}, {why_taken(fast, [slow, fast])}"
    depth = StageHealth("depth", True, 1.0, n=12, detail=detail)
    lines = status_table(Health(1, stages=(depth,)).to_json()).splitlines()
    row = next(i for i, line in enumerate(lines) if line.startswith("depth"))
    assert lines[row].endswith("B (P), the only one of 2 that works: 40 frames/s")
    assert lines[row + 1].split() == "A kernels do not build, 3 errors of clang".split()
    assert lines[row + 1].index("A") > lines[row].index("B (P)")


def test_status_ends_quietly_where_its_reader_has_gone(path: Path) -> None:
    async def test() -> None:
        async with served(path):
            for options in ([], ["--json"], ["--watch"]):
                status, said = await asyncio.to_thread(
                    into_closed_pipe, "status", *options, "--set", f"expert.daemon.socket={path}"
                )
                assert (status, said) == (READER_GONE, "")

    asyncio.run(asyncio.wait_for(test(), 60))
