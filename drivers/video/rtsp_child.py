"""Process of an RTSP server for `drivers.video.rtsp_server`, in the system's Python.

GStreamer's own server, which a virtual environment does not have; Python 3.8 will do. Its argument
is HOST, PORT and the path of the stream. It is sent pictures of H.264 (annex B, whole access
units), each after its length, and ends with its input. It prints a JSON object a line: the port,
or why there is none, then whether anybody watches whenever that changes.
"""

from __future__ import annotations

import json
import os
import signal
import struct
import sys
import threading

LENGTH = struct.Struct("<I")
MOST_WAITING = 400_000
"""Bytes that wait for the packer; beyond, pictures are left out."""
MOST_SESSIONS = 8
"""Viewers at once; more are refused: each has buffers and sockets of its own."""
LAUNCH = (
    "( appsrc name=companion_source is-live=true do-timestamp=true format=time max-bytes=2000000"
    " caps=video/x-h264,stream-format=byte-stream,alignment=au"
    " ! rtph264pay name=pay0 pt=96 config-interval=-1 )"
)


def say(**told) -> None:  # type: ignore[no-untyped-def]
    """Tell the parent."""
    sys.stdout.write(json.dumps(told) + "\n")
    sys.stdout.flush()


def main() -> None:
    """Serve until the input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the daemon
    host, port, path = sys.argv[1], sys.argv[2], sys.argv[3]
    try:
        import gi

        gi.require_version("Gst", "1.0")
        gi.require_version("GstRtspServer", "1.0")
        from gi.repository import GLib, Gst, GstRtspServer
    except (ImportError, ValueError) as error:
        say(error="GStreamer's RTSP server is missing: " + str(error))
        return
    Gst.init(None)
    if Gst.ElementFactory.find("rtph264pay") is None:
        say(error="GStreamer's good plugins are missing (rtph264pay)")
        return
    sources: list = []  # type: ignore[type-arg]

    def gone(_media) -> None:  # type: ignore[no-untyped-def]
        sources.clear()
        say(watched=False)

    def configured(_factory, media) -> None:  # type: ignore[no-untyped-def]
        sources[:] = [media.get_element().get_by_name("companion_source")]
        media.connect("unprepared", gone)
        say(watched=True)

    factory = GstRtspServer.RTSPMediaFactory()
    factory.set_launch(LAUNCH)
    factory.set_shared(True)
    factory.set_latency(0)
    factory.connect("media-configure", configured)
    server = GstRtspServer.RTSPServer()
    server.set_address(host)
    server.set_service(port)
    server.get_session_pool().set_max_sessions(MOST_SESSIONS)
    server.get_mount_points().add_factory(path, factory)
    loop = GLib.MainLoop()
    if server.attach(None) == 0:
        say(error="the port cannot be opened")
        return
    say(port=server.get_bound_port())
    feeding = threading.Thread(target=feed, args=(Gst, sources), daemon=True)
    feeding.start()
    loop.run()


def feed(Gst, sources) -> None:  # type: ignore[no-untyped-def] # noqa: N803
    """Pass on what comes; the end of it is the end of all."""
    stream = os.fdopen(0, "rb", 65536)
    while True:
        head = stream.read(LENGTH.size)
        if len(head) < LENGTH.size:
            os._exit(0)
        data = stream.read(LENGTH.unpack(head)[0])
        for source in list(sources):
            if source.get_property("current-level-bytes") < MOST_WAITING:
                source.emit("push-buffer", Gst.Buffer.new_wrapped(data))


if __name__ == "__main__":
    main()
