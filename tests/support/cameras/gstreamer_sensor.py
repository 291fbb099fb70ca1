"""Made-up libcamerasrc and nvarguscamerasrc for `drivers.camera.gstreamer_child`.

A script for the system's Python: it registers both elements, then runs the child as the camera
would. Each is a sensor before an even grey whose luma is light times exposure times gain. Names and
types of properties are those of libcamera 0.5 and of JetPack 6.
"""

# ruff: noqa: E402, N801, RUF012 - gi wants versions first; names and tables are its own
from __future__ import annotations

import runpy
import sys
from typing import Any

import gi

gi.require_version("Gst", "1.0")
from gi.repository import GObject, Gst

Gst.init(None)  # before any class of its kinds

AUTOMATIC_LEVEL, BLACK = 50, 16
KEPT: list[object] = []
"""Elements for as long as the process runs: the bindings may free one that the pipeline holds."""
READWRITE = GObject.ParamFlags.READWRITE


class _Sensor(Gst.Bin):  # type: ignore[misc]
    """Picture source whose level follows its settings; `light` is in levels per microsecond."""

    __gtype_name__ = "MadeUpSensor"
    __gstmetadata__ = ("made-up sensor", "Source/Video", "a level by exposure and gain", "tests")

    def __init__(self) -> None:
        super().__init__()
        self.values: dict[str, Any] = {
            spec.name: spec.default_value for spec in self.list_properties()
        }
        KEPT.append(self)
        source, self._balance = (
            Gst.ElementFactory.make(name) for name in ("videotestsrc", "videobalance")
        )
        source.set_property("pattern", "black")
        for element in (source, self._balance):
            self.add(element)
        source.link(self._balance)
        self.add_pad(Gst.GhostPad.new("src", self._balance.get_static_pad("src")))
        self._show()

    def do_get_property(self, spec: GObject.ParamSpec) -> object:
        return self.values[spec.name]

    def do_set_property(self, spec: GObject.ParamSpec, value: object) -> None:
        self.values[spec.name] = value
        self._show()

    def _show(self) -> None:
        level = min(max(self.level(), BLACK), 255.0)
        self._balance.set_property("brightness", (level - BLACK) / 255)

    def level(self) -> float:
        """Grey level of the picture."""
        raise NotImplementedError


class libcamerasrc(_Sensor):
    __gtype_name__ = "MadeUplibcamerasrc"
    __gproperties__ = {
        "ae-enable": (bool, "", "", True, READWRITE),
        "exposure-time": (int, "us", "", 0, 2**31 - 1, 0, READWRITE),
        "analogue-gain": (float, "", "", 0.0, 1e6, 0.0, READWRITE),
        "light": (float, "", "", 0.0, 1e3, 0.0, READWRITE),
    }

    def level(self) -> float:
        v = self.values
        if v["ae-enable"]:
            return AUTOMATIC_LEVEL
        return float(v["light"] * v["exposure-time"] * v["analogue-gain"])


class nvarguscamerasrc(_Sensor):
    __gtype_name__ = "MadeUpnvarguscamerasrc"
    __gproperties__ = {
        "exposuretimerange": (str, "ns", "", None, READWRITE),
        "gainrange": (str, "", "", None, READWRITE),
        "ispdigitalgainrange": (str, "", "", None, READWRITE),
        "light": (float, "", "", 0.0, 1e3, 0.0, READWRITE),
    }

    def level(self) -> float:
        names = "exposuretimerange", "gainrange", "ispdigitalgainrange"
        ranges = [[float(x) for x in (self.values[n] or "0 1").split()] for n in names]
        if any(least != most for least, most in ranges):
            return AUTOMATIC_LEVEL
        return float(self.values["light"]) * ranges[0][0] * 1e-3 * ranges[1][0]


for each in (libcamerasrc, nvarguscamerasrc):
    Gst.Element.register(None, each.__name__, Gst.Rank.NONE, each)
runpy.run_path(sys.argv[1], run_name="__main__")
