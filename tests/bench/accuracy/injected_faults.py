"""Known faults injected into a recorded flight for benchmarks.

Each fault changes telemetry (a sorted list), images, or both, and nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from companion.geometry.transforms import quaternion_from_rotation, rotation_from_quaternion
from companion.geometry.transforms import rotation_from_vector as turn_by
from companion.messages import Bytes, Frame, Warned
from companion.telemetry import AttitudeSample, ImuSample, PositionSample, Telemetry

Samples = list[Telemetry]
Pictures = Iterable[Frame | Warned]

DROPOUT_S, SILENT_S = 2.0, 3.0
AT_SHARE = 0.5
"""Begin of short faults, as a share of the flight."""
SHIFT_NS = 60_000_000
OFFSET_AXIS = np.array([0.6, 0.64, 0.48])
OFFSET_RAD = np.radians(5.0)
DROPPED_SHARE = 0.3
EXPOSURE_GAINS = (1.0, 0.45, 1.5, 0.7)
EXPOSURE_STEP_S = 2.0
BLUR_PX = 9
LOW_CONTRAST_GAIN, LOW_CONTRAST_NOISE = 0.15, 1.5
VELOCITY_SCALE, VELOCITY_TURN_RAD = 1.1, np.radians(8.0)

PULL_M_S, JUMP_M = np.array([0.6, 0.8, 0.0]), np.array([30.0, -40.0, 0.0])
"""Of satellites that are spoofed: 1 m/s, and 50 m; the autopilot's own estimate follows them."""


@dataclass(frozen=True, slots=True)
class Span:
    """Begin and end of a flight."""

    start_ns: int
    stop_ns: int

    @property
    def fault_ns(self) -> int:
        """Time at which short faults begin."""
        return self.start_ns + int(AT_SHARE * (self.stop_ns - self.start_ns))


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault; the images show nothing for `dropout_s` seconds from the middle of the flight."""

    name: str
    telemetry: Callable[[Samples, Span], Samples] = lambda samples, span: samples
    pictures: Callable[[Pictures, Span], Pictures] = lambda pictures, span: pictures
    dropout_s: float = 0.0

    def dropout_ns(self, span: Span) -> tuple[int, int] | None:
        """Begin and end of the image dropout; None without one."""
        if not self.dropout_s:
            return None
        return span.fault_ns, span.fault_ns + int(self.dropout_s * 1e9)


def _without_attitude(samples: Samples, span: Span) -> Samples:
    return [s for s in samples if not isinstance(s, (AttitudeSample, ImuSample))]


def _offset_attitude(samples: Samples, span: Span) -> Samples:
    """Autopilot mounted at an angle to the body."""
    turn = turn_by(OFFSET_RAD * OFFSET_AXIS / np.linalg.norm(OFFSET_AXIS))

    def askew(sample: AttitudeSample) -> AttitudeSample:
        rates = sample.rates_body_rad_s
        rotation = rotation_from_quaternion(sample.ned_from_body) @ turn
        return AttitudeSample(
            sample.t_ns, quaternion_from_rotation(rotation),
            None if rates is None else turn.T @ rates,
        )  # fmt: skip

    return [askew(s) if isinstance(s, AttitudeSample) else s for s in samples]


def _late(samples: Samples, span: Span) -> Samples:
    return [replace(s, t_ns=s.t_ns + SHIFT_NS) for s in samples]


def _silent(samples: Samples, span: Span) -> Samples:
    until_ns = span.fault_ns + int(SILENT_S * 1e9)
    return [s for s in samples if not span.fault_ns <= s.t_ns < until_ns]


def _wrong_velocity(samples: Samples, span: Span) -> Samples:
    """Compass offset, and velocity too large."""
    turn = VELOCITY_SCALE * turn_by(np.array([0.0, 0.0, VELOCITY_TURN_RAD]))

    def wrong(sample: PositionSample) -> PositionSample:
        velocity = sample.velocity_ned_m_s
        return sample if velocity is None else replace(sample, velocity_ned_m_s=turn @ velocity)

    return [wrong(s) if isinstance(s, PositionSample) else s for s in samples]


def _pulled(samples: Samples, span: Span) -> Samples:
    """Satellites pulled away from the middle of the flight on, with their velocity."""

    def pulled(sample: Telemetry) -> Telemetry:
        if not isinstance(sample, PositionSample) or sample.t_ns < span.fault_ns:
            return sample
        velocity = sample.velocity_ned_m_s
        off_m = PULL_M_S * (1e-9 * (sample.t_ns - span.fault_ns))
        return replace(
            sample, position_ned_m=sample.position_ned_m + off_m,
            velocity_ned_m_s=None if velocity is None else velocity + PULL_M_S,
        )  # fmt: skip

    return [pulled(s) for s in samples]


def _jumped(samples: Samples, span: Span) -> Samples:
    """Satellites elsewhere from the middle of the flight on."""
    return [
        replace(s, position_ned_m=s.position_ned_m + JUMP_M)
        if isinstance(s, PositionSample) and s.t_ns >= span.fault_ns
        else s
        for s in samples
    ]


def _frozen(samples: Samples, span: Span) -> Samples:
    """Satellites that stand from the middle of the flight on, as if nothing moved."""
    last: dict[object, PositionSample] = {}
    out: Samples = []
    for sample in samples:
        if isinstance(sample, PositionSample):
            if sample.t_ns < span.fault_ns:
                last[sample.source] = sample
            elif sample.source in last:
                sample = replace(last[sample.source], t_ns=sample.t_ns)
        out.append(sample)
    return out


def _edited(
    edit: Callable[[Bytes, int], Bytes],
) -> Callable[[Pictures, Span], Iterator[Frame | Warned]]:
    """Fault that edits images: a function of the grey image and the time since the start, ns."""

    def edited(pictures: Pictures, span: Span) -> Iterator[Frame | Warned]:
        for frame in pictures:
            if isinstance(frame, Frame):
                grey = edit(frame.grey, frame.t_ns - span.start_ns)
                frame = replace(frame, grey=grey, rgb=np.repeat(grey[..., None], 3, 2))
            yield frame

    return edited


def _image_dropout(pictures: Pictures, span: Span) -> Iterator[Frame | Warned]:
    until_ns = span.fault_ns + int(DROPOUT_S * 1e9)
    for frame in pictures:
        if isinstance(frame, Frame) and span.fault_ns <= frame.t_ns < until_ns:
            frame = replace(
                frame, grey=np.full_like(frame.grey, 252), rgb=np.full_like(frame.rgb, 252)
            )
        yield frame


def _dropped(pictures: Pictures, span: Span) -> Iterator[Frame | Warned]:
    rng = np.random.default_rng(30)
    for frame in pictures:
        if not isinstance(frame, Frame) or rng.random() >= DROPPED_SHARE:
            yield frame


def _every_third(pictures: Pictures, span: Span) -> Iterator[Frame | Warned]:
    for frame in pictures:
        if not isinstance(frame, Frame) or frame.seq % 3 == 0:
            yield frame


def _exposed(grey: Bytes, since_ns: int) -> Bytes:
    step = int(since_ns * 1e-9 / EXPOSURE_STEP_S) % len(EXPOSURE_GAINS)
    return np.asarray(np.clip(grey * EXPOSURE_GAINS[step], 0, 255), np.uint8)


def _low_contrast(grey: Bytes, since_ns: int) -> Bytes:
    """Hardly any contrast, and the noise of the camera on it."""
    rng = np.random.default_rng(since_ns)
    noise = rng.normal(scale=LOW_CONTRAST_NOISE, size=grey.shape)
    return np.asarray(np.clip(128 + LOW_CONTRAST_GAIN * (grey - 128.0) + noise, 0, 255), np.uint8)


def _blurred(grey: Bytes, since_ns: int) -> Bytes:
    """Motion blur along a direction that turns, for half a second in every two."""
    if (since_ns * 1e-9) % 2.0 > 0.5:
        return grey
    angle = since_ns * 1e-9
    kernel = np.zeros((BLUR_PX, BLUR_PX), np.float32)
    middle = BLUR_PX // 2
    along = np.linspace(-middle, middle, 4 * BLUR_PX)
    x = np.rint(middle + along * np.cos(angle)).astype(int)
    y = np.rint(middle + along * np.sin(angle)).astype(int)
    np.add.at(kernel, (y, x), 1.0)
    return np.asarray(cv2.filter2D(grey, -1, kernel / kernel.sum()), np.uint8)


NO_FAULT = Fault("none")
FAULTS = (
    NO_FAULT,
    Fault("no attitude", telemetry=_without_attitude),
    Fault("attitude off by 5 degrees", telemetry=_offset_attitude),
    Fault("telemetry 60 ms late", telemetry=_late),
    Fault("telemetry silent for 3 s", telemetry=_silent),
    Fault("blind for 2 s", pictures=_image_dropout, dropout_s=DROPOUT_S),
    Fault("blind for 2 s, telemetry silent for 3 s", _silent, _image_dropout, DROPOUT_S),
    Fault("velocity 10 % and 8 degrees off", telemetry=_wrong_velocity),
    Fault("30 % of frames dropped", pictures=_dropped),
    Fault("two of three frames dropped", pictures=_every_third),
    Fault("exposure steps", pictures=_edited(_exposed)),
    Fault("motion blur", pictures=_edited(_blurred)),
    Fault("faint pictures", pictures=_edited(_low_contrast)),
    Fault("satellites pulled by 1 m/s", telemetry=_pulled),
    Fault("satellites jump by 50 m", telemetry=_jumped),
    Fault("satellites frozen", telemetry=_frozen),
)
