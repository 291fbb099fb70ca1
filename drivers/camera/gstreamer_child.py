"""Process of a GStreamer pipeline for `drivers.camera.gstreamer_camera`, in the system's Python.

It needs nothing but the standard library and PyGObject, which a virtual environment does not have,
and a camera's plugin that crashes or hangs takes only this process with it. Python 3.8 will do.

It is sent the pipeline, then a byte for each picture that is wanted or exposure that is to be set
(`SET`, then `SETTING`), and ends when there is nobody left to send. What it answers is a header,
see `HEADER`, and so many bytes.
"""

from __future__ import annotations

import os
import select
import signal
import struct
import sys
import traceback
from typing import Any

HEADER = struct.Struct("<4sIIIqI")
"""Kind, width, height, bytes per row, CLOCK_MONOTONIC in ns or 0, number of bytes that follow."""
OPENED, NEVER, GONE, ENDED, FAULT = b"open", b"nevr", b"gone", b"ends", b"bugs"
"""Running; impossible, for the reason that follows; failed, likewise; no more images; a bug of this
program, whose traceback follows."""
CODES = {"NV12": b"NV12", "YUY2": b"YUYV", "GRAY8": b"GREY"}
PICTURE, SET = b".", b"e"
SETTING = struct.Struct("<If")
"""Exposure time in microseconds, gain as a factor."""
LIMITS = struct.Struct("<IIff")
"""Sent with OPENED where the exposure can be set: shortest and longest exposure time in
microseconds, least and largest gain as a factor."""
ANY_EXPOSURE_US, ANY_GAIN = (100, 1000000), (1.0, 8.0)
"""Taken where the source does not say: no exposure is longer than a frame anyhow, and sensors on
CSI ports (IMX219, IMX296, IMX477, IMX708, OV9281) have an analogue gain of 10 and more."""
LIBCAMERA = "ae-enable", "exposure-time", "analogue-gain"
ARGUS = "exposuretimerange", "gainrange", "ispdigitalgainrange"
"""Properties of libcamerasrc and of nvarguscamerasrc, by which each is known."""
APPSINK = (
    " ! videoconvert ! video/x-raw,format=(string){" + ",".join(CODES) + "}"
    " ! appsink name=companion_sink drop=true max-buffers=1"
)
POLL_NS = 100_000_000


class Answers:
    """Output stream of the answers. Not standard output: plugins print there."""

    def __init__(self) -> None:
        self._fd = os.dup(1)
        os.dup2(2, 1)

    def send(self, kind: bytes, data: bytes = b"", width=0, height=0, stride=0, t_ns=0) -> None:  # type: ignore[no-untyped-def]
        """Send one answer."""
        left = memoryview(HEADER.pack(kind, width, height, stride, t_ns, len(data)) + data)
        while left:
            left = left[os.write(self._fd, left) :]


class SettableSource:
    """Source of a pipeline whose exposure can be set while it runs."""

    def __init__(self, element: Any, is_argus: bool) -> None:
        self._element = element
        self._is_argus = is_argus
        exposure_ns = self._range_of("exposuretimerange")
        exposure_us = [max(1, int(each / 1000)) for each in exposure_ns] or ANY_EXPOSURE_US
        self.limits = LIMITS.pack(*exposure_us, *(self._range_of("gainrange") or ANY_GAIN))
        """As `LIMITS`."""

    def put(self, exposure_us: int, gain: float) -> None:
        """Set both, and put the automatic exposure off."""
        put = self._element.set_property
        if self._is_argus:  # a range of one value; no digital gain, which would undo it
            put("exposuretimerange", f"{1000 * exposure_us} {1000 * exposure_us}")
            put("gainrange", f"{gain:g} {gain:g}")
            put("ispdigitalgainrange", "1 1")
        else:
            put("ae-enable", False)
            put("exposure-time", exposure_us)
            put("analogue-gain", gain)

    def _range_of(self, name: str) -> list[float]:
        """Range that the pipeline gives to a property of Argus; empty without."""
        text = self._element.get_property(name) if self._is_argus else ""
        try:
            ends = [float(each) for each in (text or "").split()]
        except ValueError:  # the element will say so itself
            return []
        return ends if len(ends) == 2 and 0 < ends[0] <= ends[1] else []


def settable_source(Gst: Any, pipeline: Any) -> SettableSource | None:  # noqa: N803
    """The first source of the pipeline whose exposure can be set, known by its properties."""
    found = pipeline.iterate_recurse()
    while True:
        result, element = found.next()
        if result != Gst.IteratorResult.OK:
            return None
        for names in (LIBCAMERA, ARGUS):
            if all(element.find_property(name) for name in names):
                return SettableSource(element, names == ARGUS)


def main() -> None:
    """Run one pipeline."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the one that asks
    answers = Answers()
    try:
        _serve_one(answers)
    except BrokenPipeError:
        pass  # nobody is left
    except Exception:
        answers.send(FAULT, traceback.format_exc().encode())


def _serve_one(answers: Answers) -> None:
    try:
        import gi

        gi.require_version("Gst", "1.0")
        from gi.repository import GLib, Gst
    except (ImportError, ValueError) as error:
        answers.send(NEVER, b"PyGObject or GStreamer is missing (%s)" % str(error).encode())
        return
    Gst.init(None)
    (length,) = struct.unpack("<I", _read(4))
    text = _read(length).decode()
    try:
        pipeline = Gst.parse_launch(text + APPSINK)
        sink = pipeline.get_by_name("companion_sink")
    except GLib.Error as error:
        answers.send(NEVER, str(getattr(error, "message", error)).encode())
        return
    try:
        _serve(Gst, pipeline, sink, answers)
    finally:
        pipeline.set_state(Gst.State.NULL)


def _serve(Gst, pipeline, sink, answers) -> None:  # type: ignore[no-untyped-def]  # noqa: N803
    clock = Gst.SystemClock.obtain()
    clock.set_property("clock-type", Gst.ClockType.MONOTONIC)
    pipeline.use_clock(clock)  # so that stamps are of CLOCK_MONOTONIC, whatever plugins offer
    change = pipeline.set_state(Gst.State.PAUSED)
    # what is not live, a file, would else come as fast as it can be read
    sink.set_property("sync", change != Gst.StateChangeReturn.NO_PREROLL)
    if change != Gst.StateChangeReturn.FAILURE:
        change = pipeline.set_state(Gst.State.PLAYING)
    bus = pipeline.get_bus()
    if change == Gst.StateChangeReturn.FAILURE:
        answers.send(GONE, _fault(Gst, bus) or b"the pipeline does not start")
        return
    source = settable_source(Gst, pipeline)
    answers.send(OPENED, source.limits if source is not None else b"")
    while True:
        asked = os.read(0, 1)
        if asked == SET and source is not None:
            source.put(*SETTING.unpack(_read(SETTING.size)))
            continue
        if not asked:
            return
        sample = None
        while sample is None:
            sample = sink.emit("try-pull-sample", POLL_NS)
            if sample is not None:
                break
            fault = _fault(Gst, bus)
            if fault or sink.get_property("eos"):
                answers.send(GONE if fault else ENDED, fault or b"the pipeline has ended")
                return
            if _nobody_asks():
                return
        _answer(Gst, pipeline, sample, answers)


def _answer(Gst, pipeline, sample, answers) -> None:  # type: ignore[no-untyped-def]  # noqa: N803
    form = sample.get_caps().get_structure(0)
    width, height = form.get_int("width")[1], form.get_int("height")[1]
    code = CODES[form.get_string("format")]
    # the default layout, unless an appsink negotiates another
    stride = ((2 * width if code == b"YUYV" else width) + 3) // 4 * 4
    buffer = sample.get_buffer()
    t_ns = 0
    if buffer.pts != Gst.CLOCK_TIME_NONE:
        running_ns = sample.get_segment().to_running_time(Gst.Format.TIME, buffer.pts)
        if running_ns != Gst.CLOCK_TIME_NONE:
            t_ns = running_ns + pipeline.get_base_time()
    data = buffer.extract_dup(0, buffer.get_size())
    answers.send(code, data, width, height, stride, t_ns)


def _fault(Gst, bus) -> bytes:  # type: ignore[no-untyped-def]  # noqa: N803
    message = bus.pop_filtered(Gst.MessageType.ERROR)
    # what is for debugging may hold addresses with passwords
    return message.parse_error()[0].message.encode() if message is not None else b""


def _nobody_asks() -> bool:
    poll = select.poll()
    poll.register(0, select.POLLIN)
    return any(event & select.POLLHUP for _, event in poll.poll(0))


def _read(n: int) -> bytes:
    out = b""
    while len(out) < n:
        part = os.read(0, n - len(out))
        if not part:
            sys.exit(0)
        out += part
    return out


if __name__ == "__main__":
    main()
