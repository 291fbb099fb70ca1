"""Steps of setting up, each ticked off by the status of the daemon itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from companion.config import Config
from companion.page.remedies import OF_REASON, OTHER

State = Literal["done", "todo", "unknown"]
MOUNT_WARNINGS = (
    "camera does not turn with the body: attitude not used, no vision position",
    "camera mount disagrees with the autopilot's attitude: no vision position",
    "the autopilot's attitude is not the camera's and is not used",
)
MOUNT_GOOD = "camera turns with the body again: attitude used"
TURN = (
    "Turn the drone by hand about all its axes for 20 seconds, over something with structure: then "
    "this is ticked off."
)
RECENT_S = 120.0
DEVICES = "/setup/devices", "Cameras and serial ports"
MOUNT = "/setup/mount", "Find the mount"
PARAMETERS = "#parameters", "The parameters"
SOME = 0.5
"""Share of the configured frame rate below which the camera is said to be slow."""


@dataclass(frozen=True, slots=True)
class Step:
    """A step: what it is, whether it is done, what is so, and what is to be done.

    `to` is where that is done, a place of the page, and `link` the words that lead there.
    """

    key: str
    title: str
    state: State
    found: str
    todo: str = ""
    to: str = ""
    link: str = ""


def steps(
    status: Mapping[str, Any], config: Config, examined: Mapping[str, Any] | None
) -> list[Step]:
    """All steps in order; `examined` is what `companion doctor` found, None before it was asked."""
    told = [
        _camera(status, config), _lens(status, config), _mount(status, config),
        _autopilot(status, config), _parameters(config, examined), _place(status, config),
    ]  # fmt: skip
    return [*told, _ready(status, config, told)]


def source(status: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Status of a source; {} where it is not there."""
    found = (each for each in status.get("sources") or () if each.get("name") == name)
    return next(found, {})


def _camera(status: Mapping[str, Any], config: Config) -> Step:
    camera = source(status, "camera")
    size, rate_hz = status.get("size"), camera.get("rate_hz") or 0.0
    if camera.get("state") == "running" and size:
        found = f"{size[0]} x {size[1]} pixels, {rate_hz:.1f} a second."
        if rate_hz < SOME * config.camera.rate_hz:
            wanted = f"{config.camera.rate_hz:g} were asked for: {_slow(config.camera.source)}"
            return Step("camera", "Camera", "todo", found, wanted, "#camera", "Camera settings")
        return Step("camera", "Camera", "done", found)
    detail = f" ({camera['detail']})" if camera.get("detail") else ""
    found = f"The camera is {camera.get('state', 'not known')}{detail}."
    return Step(
        "camera", "Camera", "todo", found, "Check its cable, then which one is set.", *DEVICES
    )


def _slow(source: str) -> str:
    if source == "v4l2":
        return "more light, or a shorter exposure."
    return "set camera.rate_hz to what this camera gives."


def _lens(status: Mapping[str, Any], config: Config) -> Step:
    camera = config.camera
    own = camera.source == "pattern" or (camera.source == "file" and not camera.calibration)
    if camera.calibration:
        found = f"Calibrated: {camera.calibration}"
        if "lens" in status.get("unproven", ()):
            found += ". Turns of the drone have not shown yet that it fits."
        return Step("lens", "Lens", "done", found)
    if own:
        return Step("lens", "Lens", "done", "This camera brings its own calibration.")
    found = f"Not calibrated: taken to be {camera.assumed_hfov_deg:g} degrees wide, undistorted."
    todo = "Calibrate it with a board, on a screen or printed."
    return Step("lens", "Lens", "todo", found, todo, "/setup/lens", "Calibrate the lens")


def _mount(status: Mapping[str, Any], config: Config) -> Step:
    if not status.get("size"):
        return Step("mount", "Mount", "unknown", "Known once the camera runs.")
    if not status.get("mount_known"):
        found = "It is not known how the camera sits on the drone: no pose is sent."
        todo = "Turn the drone by hand, and it is found; or state its angles."
        return Step("mount", "Mount", "todo", found, todo, *MOUNT)
    for each in status.get("warnings") or ():
        if each["what"] == MOUNT_GOOD:
            break
        if each["what"] in MOUNT_WARNINGS and each["age_s"] < RECENT_S:
            found = f"{each['what']}. {each['detail']}"
            return Step("mount", "Mount", "todo", found, "Find it anew, or correct it.", *MOUNT)
    mount = config.mount
    found = "Stated by the calibration file."
    if mount.known:
        found = (
            f"Stated: roll {mount.roll_deg:g}, pitch {mount.pitch_deg:g}, yaw {mount.yaw_deg:g} "
            "degrees. Nothing contradicts it."
        )
    if "mount" in status.get("unproven", ()):
        found += " Nothing has shown yet that it is so."
        return Step("mount", "Mount", "todo", found, TURN, *MOUNT)
    return Step("mount", "Mount", "done", found)


def _autopilot(status: Mapping[str, Any], config: Config) -> Step:
    if not config.link.url:
        found = "No link to an autopilot is set."
        return Step("autopilot", "Autopilot", "todo", found, "Choose its port.", *DEVICES)
    autopilot = source(status, "autopilot")
    detail = f" {autopilot['detail']}." if autopilot.get("detail") else ""
    if autopilot.get("state") == "running":
        found = f"Heard, {autopilot.get('rate_hz') or 0:.0f} messages a second.{detail}"
        return Step("autopilot", "Autopilot", "done", found)
    found = f"The autopilot is {autopilot.get('state', 'not known')}.{detail}"
    todo = f"Nothing useful comes by {config.link.url}: cable, TX and RX crossed, baud, power."
    return Step("autopilot", "Autopilot", "todo", found, todo, *DEVICES)


def _parameters(config: Config, examined: Mapping[str, Any] | None) -> Step:
    title = "Parameters"
    if examined is None:
        found = "Not examined since this page was started."
        return Step("parameters", title, "unknown", found, "Examine them.", *PARAMETERS)
    if "error" in examined:
        error, todo = str(examined["error"]), "Examine them again."
        return Step("parameters", title, "todo", error, todo, *PARAMETERS)
    n = len(examined["in_the_way"])
    if n:
        plural = "parameter stands" if n == 1 else "parameters stand"
        found = f"{n} {plural} in the way of {examined['mode']}."
        return Step("parameters", title, "todo", found, "Set them.", *PARAMETERS)
    found = f"Nothing stands in the way of {examined['mode']} ({examined['n_examined']} examined)."
    if examined.get("reboot_needed"):
        return Step("parameters", title, "todo", found, "Reboot the autopilot.")
    return Step("parameters", title, "done", found)


def _place(status: Mapping[str, Any], config: Config) -> Step:
    origin, feedback = status.get("origin"), config.feedback
    if origin:
        found = (
            f"The autopilot's origin is {origin['latitude_deg']:.6f}, "
            f"{origin['longitude_deg']:.6f}, {origin['altitude_m']:.0f} m."
        )
        return Step("place", "Place and origin", "done", found)
    if feedback.origin_latitude_deg or feedback.origin_longitude_deg:
        found = (
            f"{feedback.origin_latitude_deg:.6f}, {feedback.origin_longitude_deg:.6f} is given to "
            "an autopilot without one."
        )
        return Step("place", "Place and origin", "done", found)
    found = "No origin is known yet. With satellites the autopilot finds it by itself."
    todo = "Without satellites: state the place, so that it can use a position."
    return Step("place", "Place and origin", "unknown", found, todo, "#place", "State the place")


def _ready(status: Mapping[str, Any], config: Config, told: list[Step]) -> Step:
    title = "Ready to fly"
    needed = ("camera", "mount", "autopilot")
    first = next((each for each in told if each.key in needed and each.state != "done"), None)
    if first is not None:
        found = f"Not ready: {first.title}. {first.found}"
        return Step("ready", title, "todo", found, first.todo, first.to, first.link)
    if config.feedback.mode == "off":
        found = "Not ready: poses are not sent (feedback.mode is off)."
        return Step(
            "ready", title, "todo", found, "Switch it on.", "#ready", "Poses to the autopilot"
        )
    feedback = status.get("feedback") or {}
    if not feedback.get("sending"):
        why = feedback.get("why_not") or "no pose yet"
        return Step("ready", title, "todo", f"Not ready: {why}.", OF_REASON.get(why, OTHER))
    going = f"{feedback.get('rate_hz') or 0:.0f} poses a second go to the autopilot"
    parameters = next(each for each in told if each.key == "parameters")
    if parameters.state == "todo":
        found = f"Not ready: {parameters.found}"
        return Step("ready", title, "todo", found, parameters.todo, *PARAMETERS)
    if parameters.state == "unknown":
        found = f"{going}; whether it uses them is not known."
        return Step("ready", title, "unknown", found, "Examine the parameters.", *PARAMETERS)
    return Step("ready", title, "done", f"Ready: {going}.")
