"""`companion devices --bench`: speed of this computer, what it can carry, and which profile fits.

Localisation is measured on the first seconds of the sample flight, by the processor time of its
one thread, so that other work hardly shows; OpenCL devices as for `opencl.device = auto`.
"""

from __future__ import annotations

import dataclasses
import json
import os
from dataclasses import dataclass
from itertools import islice

import numpy as np

from companion.app.sample_flight import sample_flight
from companion.compute.compute_devices import remeasured_devices
from companion.config import Config
from companion.config.computer_settings import NO_PROFILE
from companion.config_file import of_profile
from companion.dense.depth_stage import N_UPDATES
from companion.dense.device_choice import MeasuredDevice, in_order
from companion.dense.opencl import PROCESSOR
from companion.estimation.localisation import LocalisationStage
from companion.messages import Frame, KeyframeAdded
from companion.runtime.in_order import in_order_of_time
from companion.timing.clock import StageTimes, thread_s
from drivers.open_flight import open_flight

N_FRAMES, N_WARM_UP = 200, 60
"""Frames of the sample flight, and those at first that do not count: the map begins there."""
LEAD_NS = 10_000_000_000
"""Telemetry before the first frame, from which the attitude comes."""
BESIDE = 0.8
"""Cores for all but localisation and dense map, for each core of localisation: 1.03 cores in all,
0.46 and 0.20 of these two, in the live daemon (docs/performance.md)."""
MOST_LOAD = 0.8
"""Largest share of all cores; beyond it, frames wait."""
MEASURED_STRIDE = Config().depth.stride
"""Pixel step at which OpenCL devices are measured."""
CANDIDATES = ("desktop", "n100", "pi5", "pi4")
"""Profiles, the most demanding first. That of the Orin Nano asks for as much as that of the Pi 5.
"""


@dataclass(frozen=True, slots=True)
class Speed:
    """Measured speed. Times are milliseconds of one core, for 640 x 480 and default settings."""

    n_cores: int
    frame_ms: float
    """Median of a frame that is no keyframe."""
    frame_p95_ms: float
    keyframe_ms: float
    """Mean of a keyframe, mapping included."""
    keyframes_per_s: float
    """Of the sample flight, at the time of its own stamps."""
    depth_device: str
    """Name of the best OpenCL device; "" without one."""
    depth_on_processor: bool
    depth_images_per_s: float
    """By that device, at `MEASURED_STRIDE`; 0 without one."""


def computer_speed(as_json: bool) -> str:
    """Measure this computer; text for people, or JSON."""
    speed = measured_speed(remeasured_devices())
    profile = fitting_profile(speed)
    if as_json:
        document = {**dataclasses.asdict(speed), "profile": profile}
        return json.dumps(document, indent=2, ensure_ascii=False)
    return "\n".join(said(speed, profile))


def measured_speed(devices: list[MeasuredDevice]) -> Speed:
    """Speed of localisation, measured now, and of the best of the devices."""
    frames_ms, keyframes_ms, seconds = localised()
    best = next(iter(in_order(devices)), None)
    return Speed(
        n_cores=len(os.sched_getaffinity(0)),
        frame_ms=float(np.median(frames_ms)), frame_p95_ms=float(np.percentile(frames_ms, 95)),
        keyframe_ms=float(np.mean(keyframes_ms)), keyframes_per_s=len(keyframes_ms) / seconds,
        depth_device=best.named if best else "",
        depth_on_processor=best is not None and best.kind == PROCESSOR,
        depth_images_per_s=(best.frames_per_s or 0.0) if best else 0.0,
    )  # fmt: skip


def localised() -> tuple[list[float], list[float], float]:
    """Milliseconds of each frame and of each keyframe, and for how long they were flown, s."""
    config = Config()
    flight = open_flight(sample_flight(), config.camera, config.telemetry)
    samples = [s for s in flight.telemetry().samples if s.t_ns >= flight.start_ns - LEAD_NS]
    stage = LocalisationStage(config, flight.camera, StageTimes())
    frames: list[float] = []
    keyframes: list[float] = []
    times_ns: list[int] = []
    spent_ms, n_frames = 0.0, 0
    for message in in_order_of_time(samples, islice(flight.frames(), N_FRAMES)):
        began_s, is_keyframe = thread_s(), False
        for out in stage.step(message):
            is_keyframe |= isinstance(out, KeyframeAdded)
        spent_ms += (thread_s() - began_s) * 1e3
        if isinstance(message, Frame):
            n_frames += 1
            if n_frames > N_WARM_UP:
                (keyframes if is_keyframe else frames).append(spent_ms)
                times_ns.append(message.t_ns)
            spent_ms = 0.0
    return frames, keyframes, (times_ns[-1] - times_ns[0]) * 1e-9


def fitting_profile(speed: Speed) -> str:
    """The most demanding profile that the computer carries; NO_PROFILE where it carries none."""
    return next((name for name in CANDIDATES if not why_unfit(speed, name)), NO_PROFILE)


def why_unfit(speed: Speed, profile: str) -> str:
    """Reason why the computer does not carry a profile; "" where it does."""
    config = of_profile(profile)
    rate_hz = config.camera.rate_hz
    if speed.frame_p95_ms * rate_hz > 1000.0:
        return f"a frame takes {speed.frame_p95_ms:.0f} ms, and there are {rate_hz:.0f} a second"
    depth_share = 0.0
    if config.depth.enabled:
        wanted = depth_images_wanted(speed, config.depth.stride)
        if wanted > MOST_LOAD * speed.depth_images_per_s:
            return f"its dense map wants {wanted:.0f} images/s"
        depth_share = wanted / speed.depth_images_per_s
    wanted_cores = cores_wanted(speed, rate_hz, depth_share)
    if wanted_cores > MOST_LOAD * speed.n_cores:
        return f"it wants {wanted_cores:.1f} cores"
    return ""


def depth_images_wanted(speed: Speed, stride: int) -> float:
    """Images for the dense map, 1/s, of as much work as one at `MEASURED_STRIDE`.

    As if every keyframe became a depth map, which is more than do.
    """
    return speed.keyframes_per_s * N_UPDATES * (MEASURED_STRIDE / stride) ** 2


def cores_wanted(speed: Speed, rate_hz: float, depth_share: float) -> float:
    """Cores that the daemon wants; `depth_share` of the time the depth device is busy."""
    localisation = 1e-3 * (speed.frame_ms * rate_hz + speed.keyframe_ms * speed.keyframes_per_s)
    on_cores = depth_share * speed.n_cores if speed.depth_on_processor else 0.0
    return localisation * (1.0 + BESIDE) + on_cores


def said(speed: Speed, profile: str) -> list[str]:
    """Lines for people."""
    lines = [
        f"Localisation, 640 x 480, time of one of {speed.n_cores} cores",
        f"  a frame {speed.frame_ms:.1f} ms, 95th percentile {speed.frame_p95_ms:.1f} ms;"
        f" a keyframe {speed.keyframe_ms:.0f} ms",
        f"  alone it keeps up with {1e3 / speed.frame_p95_ms:.0f} frames/s",
        "Dense map",
    ]
    if speed.depth_device:
        wanted = depth_images_wanted(speed, MEASURED_STRIDE)
        lines += [
            f"  {speed.depth_device}: {speed.depth_images_per_s:.0f} images/s at"
            f" expert.depth.stride = {MEASURED_STRIDE}; the sample flight wants {wanted:.0f}"
        ]
    else:
        lines += ["  no OpenCL device that works: depth.enabled = false"]
    lines += ["Profile"]
    for name in CANDIDATES:
        why = why_unfit(speed, name)
        lines += [f"  {name:8} {f'too much: {why}' if why else 'fits'}"]
    if profile == NO_PROFILE:
        return [*lines, "  none fits: a smaller image, or fewer of them"]
    return [*lines, f"  companion run --profile {profile}"]
