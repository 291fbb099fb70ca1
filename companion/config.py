"""What can be set, with its default, in one place.

Each section is a frozen dataclass; a stage takes its own section only. `config/companion.toml`
describes every key. An unknown key or a wrong type is a ConfigError that names the nearest key.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class CameraConfig:
    """What to do about a camera without calibration."""

    assumed_hfov_deg: float = 75.0
    """Horizontal field of view taken when a flight has no camera.json; 0 refuses such flights."""


@dataclass(frozen=True, slots=True)
class FeaturesConfig:
    """The ORB front end."""

    n_features: int = 1200
    n_levels: int = 8
    scale_factor: float = 1.2
    fast_threshold: int = 12
    cell_px: int = 32
    """Features are spread over cells of this size."""


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """Tracking and keyframes."""

    min_inliers: int = 20
    """Fewer map points found than this and the frame is lost."""
    min_init_parallax_deg: float = 1.0
    """The two initial keyframes are at least this far apart, seen from the points."""
    keyframe_min_share: float = 0.75
    """A new keyframe comes when fewer than this share of the reference's points are seen."""
    keyframe_parallax_deg: float = 3.0
    """A new keyframe comes when the view of the points has turned by this much."""
    keyframe_max_s: float = 3.0


@dataclass(frozen=True, slots=True)
class MappingConfig:
    """Triangulation and bundle adjustment."""

    window: int = 10
    """Keyframes adjusted together."""
    n_fixed: int = 10
    """Older keyframes that see the same points and hold them."""
    iterations: int = 6


@dataclass(frozen=True, slots=True)
class GeoreferenceConfig:
    """Scale, heading and origin from the autopilot."""

    min_travel_m: float = 3.0
    """No scale before the autopilot has moved this far."""
    max_sigma_scale: float = 0.1
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


@dataclass(frozen=True, slots=True)
class CloudConfig:
    """The fused cloud."""

    voxel_m: float = 0.10
    """One point is kept in each cube of this size; in map units times the median depth / 100 while
    there is no metric scale."""


@dataclass(frozen=True, slots=True)
class ViewerConfig:
    """The recording and the live viewer."""

    jpeg_quality: int = 60
    image_width: int = 640


@dataclass(frozen=True, slots=True)
class Config:
    """All sections."""

    camera: CameraConfig = field(default_factory=CameraConfig)
    features: FeaturesConfig = field(default_factory=FeaturesConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    georeference: GeoreferenceConfig = field(default_factory=GeoreferenceConfig)
    opencl: OpenclConfig = field(default_factory=OpenclConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)
    cloud: CloudConfig = field(default_factory=CloudConfig)
    viewer: ViewerConfig = field(default_factory=ViewerConfig)
