"""What can be set, with its default, in one place.

Each section is a frozen dataclass; a stage takes its own section only. `config/companion.toml`
describes every key. An unknown key or a wrong type is a ConfigError that names the nearest key.

A key is a bool, int, float or str; `Annotated` with a `Range` or `OneOf` says what values it takes,
which is checked where a configuration is read (`companion.config_file`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated


@dataclass(frozen=True, slots=True)
class Range:
    """Values from `least` to `most`, both included."""

    least: float
    most: float = math.inf

    def allows(self, value: float) -> bool:
        """Whether a key may have this value."""
        return self.least <= value <= self.most

    def __str__(self) -> str:
        if math.isinf(self.most):
            return f"{self.least:g} or more"
        return f"{self.least:g} to {self.most:g}"


@dataclass(frozen=True, slots=True)
class OneOf:
    """One of a few words."""

    words: tuple[str, ...]

    def allows(self, value: str) -> bool:
        """Whether a key may have this value."""
        return value in self.words

    def __str__(self) -> str:
        return "one of " + ", ".join(self.words)


@dataclass(frozen=True, slots=True)
class CameraConfig:
    """What to do about a camera without calibration."""

    assumed_hfov_deg: Annotated[float, Range(0, 150)] = 75.0
    """Horizontal field of view taken when a flight has no camera.json; 0 refuses such flights."""


@dataclass(frozen=True, slots=True)
class TelemetryConfig:
    """How the autopilot's log is put on the flight's clock."""

    offset_s: Annotated[float, Range(-1e10, 1e10)] = 0.0
    """Added to all times of the log, for a log or a video whose clock was set wrong."""
    starts_with_video: bool = False
    """Whether a log without absolute time is taken to begin with the video; else it is not used."""


@dataclass(frozen=True, slots=True)
class FeaturesConfig:
    """The ORB front end."""

    n_features: Annotated[int, Range(100, 20000)] = 1200
    n_levels: Annotated[int, Range(1, 16)] = 8
    scale_factor: Annotated[float, Range(1.05, 2)] = 1.2
    fast_threshold: Annotated[int, Range(1, 255)] = 12
    """Contrast that a corner has at least, in grey levels, where the scene is rich."""
    min_fast_threshold: Annotated[int, Range(1, 255)] = 4
    """The same where the scene is dull."""
    cell_px: Annotated[int, Range(8, 512)] = 32
    """Features are spread over cells of this size."""


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """Tracking and keyframes."""

    min_inliers: Annotated[int, Range(6, 1000)] = 20
    """Fewer map points found than this and the frame is lost."""
    min_init_parallax_deg: Annotated[float, Range(0.1, 30)] = 1.0
    """The two initial keyframes are at least this far apart, seen from the points."""
    keyframe_min_share: Annotated[float, Range(0.05, 1)] = 0.75
    """A new keyframe comes when fewer than this share of the reference's points are seen."""
    keyframe_parallax_deg: Annotated[float, Range(0.1, 45)] = 3.0
    """A new keyframe comes when the view of the points has turned by this much."""
    keyframe_max_s: Annotated[float, Range(0.05, 3600)] = 3.0
    restart_after_s: Annotated[float, Range(0, 3600)] = 1.0
    """A camera that has been lost for so long may begin a new segment of the map."""


@dataclass(frozen=True, slots=True)
class MappingConfig:
    """Triangulation and bundle adjustment."""

    window: Annotated[int, Range(2, 100)] = 10
    """Keyframes adjusted together."""
    n_fixed: Annotated[int, Range(1, 200)] = 10
    """Older keyframes that see the same points and hold them."""
    iterations: Annotated[int, Range(1, 100)] = 6
    final_iterations: Annotated[int, Range(1, 100)] = 8
    """Of the adjustment of the whole map when the flight is over."""


@dataclass(frozen=True, slots=True)
class GeoreferenceConfig:
    """Scale, heading and origin from the autopilot."""

    min_travel_m: Annotated[float, Range(0.1, 10000)] = 3.0
    """No scale before the autopilot has moved this far."""
    max_sigma_scale: Annotated[float, Range(0.001, 1)] = 0.1
    """No scale while its standard deviation is larger than this share."""


@dataclass(frozen=True, slots=True)
class OpenclConfig:
    """Where kernels run."""

    device: str = "auto"
    """"auto", or a part of a device's or platform's name, or "platform:device" by number."""


@dataclass(frozen=True, slots=True)
class DepthConfig:
    """The dense depth filter."""

    enabled: bool = True
    stride: Annotated[int, Range(1, 8)] = 2
    """Depth is estimated for every so many pixels; images are matched at full size."""
    reference_step: Annotated[float, Range(0, 10)] = 0.15
    """A keyframe gets a depth map when it is this far from the last, as a share of the depth."""
    n_updates: Annotated[int, Range(3, 100)] = 7
    """Frames that a keyframe's depth is made of, chosen by their baselines."""
    max_baseline: Annotated[float, Range(0.01, 1)] = 0.20
    """Longest baseline used, as a share of the median depth."""
    lag_keyframes: Annotated[int, Range(1, 20)] = 2
    """A keyframe waits for so many later ones, whose frames and adjusted poses it uses."""
    min_zncc: Annotated[float, Range(0, 1)] = 0.65
    """Least correlation of a match."""
    peak_margin: Annotated[float, Range(0, 1)] = 0.05
    """A second peak this near to the best makes a match ambiguous."""
    noise_grey: Annotated[float, Range(0, 50)] = 1.5
    """Patches whose grey levels vary less than this are blank."""
    pose_error_px: Annotated[float, Range(0.01, 2)] = 0.15
    """Error of a match that comes from the poses, whatever the texture."""
    converged_sigma: Annotated[float, Range(0.0001, 0.1)] = 0.006
    """Relative standard deviation at which a pixel has converged."""
    min_inlier_ratio: Annotated[float, Range(0, 1)] = 0.6
    """Share of good measurements that a converged pixel has at least."""
    regularise_iterations: Annotated[int, Range(0, 1000)] = 60
    regularise_weight: Annotated[float, Range(0.001, 1000)] = 20.0
    """Weight of the measurements against smoothness."""


@dataclass(frozen=True, slots=True)
class CloudConfig:
    """The fused cloud."""

    voxel_m: Annotated[float, Range(0.001, 100)] = 0.10
    """One point is kept in each cube of this size; a hundredth of the median depth while there is
    no metric scale."""
    min_agreeing: Annotated[int, Range(0, 4)] = 1
    """Other keyframes whose depth must agree with a point's."""
    agreement: Annotated[float, Range(0.001, 0.2)] = 0.015
    """Relative difference of depth up to which two keyframes agree."""


@dataclass(frozen=True, slots=True)
class ViewerConfig:
    """The recording and the live viewer."""

    jpeg_quality: Annotated[int, Range(1, 100)] = 60
    image_width: Annotated[int, Range(32, 8192)] = 640


@dataclass(frozen=True, slots=True)
class Config:
    """All sections."""

    camera: CameraConfig = field(default_factory=CameraConfig)
    telemetry: TelemetryConfig = field(default_factory=TelemetryConfig)
    features: FeaturesConfig = field(default_factory=FeaturesConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    georeference: GeoreferenceConfig = field(default_factory=GeoreferenceConfig)
    opencl: OpenclConfig = field(default_factory=OpenclConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)
    cloud: CloudConfig = field(default_factory=CloudConfig)
    viewer: ViewerConfig = field(default_factory=ViewerConfig)
