"""A real RTSP server on loopback, run by the system's Python: GStreamer's own.

It plays a video file at /film, and at /live pictures that tell CLOCK_MONOTONIC in milliseconds by
24 upright bars, the lowest bit at the left. It prints its port, and ends when its input does.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

SYSTEM_PYTHON = "/usr/bin/python3"
WIDTH, HEIGHT, RATE_HZ = 320, 240, 30
N_BARS = 24
BAR_PX = WIDTH // N_BARS


def missing() -> str:
    """Why there can be no server here; "" where there can."""
    check = (
        "import gi; gi.require_version('GstRtspServer', '1.0');"
        "from gi.repository import Gst, GstRtspServer; Gst.init(None);"
        "names = 'appsrc videoconvert jpegenc rtpjpegpay qtdemux rtph264pay'.split();"
        "assert all(map(Gst.ElementFactory.find, names))"
    )
    try:
        done = subprocess.run([SYSTEM_PYTHON, "-I", "-c", check], capture_output=True)
    except OSError as error:
        return str(error)
    return "" if done.returncode == 0 else "apt install gir1.2-gst-rtsp-server-1.0"


@contextmanager
def rtsp_server(film: Path, port: int = 0, password: str = "") -> Iterator[int]:
    """Its port, for as long as it runs; with a password the user is called pilot."""
    asked = json.dumps({"film": str(film), "port": port, "password": password})
    child = subprocess.Popen(
        [SYSTEM_PYTHON, "-I", __file__, asked], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert child.stdin is not None and child.stdout is not None
    try:
        yield int(child.stdout.readline())
    finally:
        child.stdin.close()
        child.kill()  # as when a camera loses its power
        child.wait()
        child.stdout.close()


def told_ms(row: bytes) -> int:
    """The time that a row of a picture of /live tells, modulo 2^24 ms."""
    return sum((row[BAR_PX * bit + BAR_PX // 2] > 127) << bit for bit in range(N_BARS))


def _picture(now_ns: int) -> bytes:
    now_ms = now_ns // 1_000_000
    bars = [b"\xe0" if now_ms >> bit & 1 else b"\x20" for bit in range(N_BARS)]
    row = b"".join(bar * BAR_PX for bar in bars)
    return (row + b"\x20" * (WIDTH - len(row))) * HEIGHT


def _serve(asked: dict[str, object]) -> None:
    import gi

    gi.require_version("Gst", "1.0")
    gi.require_version("GstRtspServer", "1.0")
    from gi.repository import GLib, Gst, GstRtspServer

    Gst.init(None)
    server = GstRtspServer.RTSPServer()
    server.set_address("127.0.0.1")
    server.set_service(str(asked["port"]))
    film = GstRtspServer.RTSPMediaFactory()
    film.set_launch(
        f"( filesrc location={asked['film']} ! qtdemux ! rtph264pay name=pay0 config-interval=1 )"
    )
    live = GstRtspServer.RTSPMediaFactory()
    live.set_launch(
        "( appsrc name=source is-live=true format=time do-timestamp=true "
        f"caps=video/x-raw,format=GRAY8,width={WIDTH},height={HEIGHT},framerate={RATE_HZ}/1 "
        "! videoconvert ! video/x-raw,format=I420 ! jpegenc ! rtpjpegpay name=pay0 )"
    )

    def configured(_: object, media: object) -> None:
        source = media.get_element().get_by_name_recurse_up("source")  # type: ignore[attr-defined]

        def push() -> bool:
            made = Gst.Buffer.new_wrapped(_picture(time.monotonic_ns()))
            return bool(source.emit("push-buffer", made) == Gst.FlowReturn.OK)

        GLib.timeout_add(1000 // RATE_HZ, push)

    live.connect("media-configure", configured)
    for path, factory in (("/film", film), ("/live", live)):
        if asked["password"]:
            permissions = GstRtspServer.RTSPPermissions()
            for right in ("media.factory.access", "media.factory.construct"):
                permissions.add_permission_for_role("pilot", right, True)
            factory.set_permissions(permissions)
        server.get_mount_points().add_factory(path, factory)
    if asked["password"]:
        auth = GstRtspServer.RTSPAuth()
        basic = GstRtspServer.RTSPAuth.make_basic("pilot", asked["password"])
        token = GstRtspServer.RTSPToken()
        token.set_string("media.factory.role", "pilot")
        auth.add_basic(basic, token)
        server.set_auth(auth)
    server.attach(None)
    print(server.get_bound_port(), flush=True)
    loop = GLib.MainLoop()
    GLib.io_add_watch(0, GLib.IO_HUP, lambda *_: loop.quit())
    loop.run()


if __name__ == "__main__":
    _serve(json.loads(sys.argv[1]))
