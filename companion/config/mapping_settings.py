"""Tracking, scale and the dense map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from companion.config.setting_kinds import Expert


@dataclass(frozen=True, slots=True)
class FeaturesConfig:
    """The ORB front end."""

    n_features: Expert[Annotated[int, Meta(ge=100, le=20000)]] = 1200
    """Features extracted from each frame."""
    n_levels: Expert[Annotated[int, Meta(ge=1, le=16)]] = 8
    """Levels of the image pyramid."""
    scale_factor: Expert[Annotated[float, Meta(ge=1.05, le=2)]] = 1.2
    """Scale from one level to the next."""


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """Tracking."""

    min_inliers: Expert[Annotated[int, Meta(ge=6, le=1000)]] = 20
    """Least map points found; with fewer the frame is lost."""
    restart_after_s: Expert[Annotated[float, Meta(ge=0, le=3600)]] = 1.0
    """A camera lost for this long may begin a new segment of the map, seconds; with the autopilot's
    attitude after 0.4 of it."""


@dataclass(frozen=True, slots=True)
class GeoreferenceConfig:
    """Scale, heading and origin from the autopilot."""

    min_travel_m: Expert[Annotated[float, Meta(ge=0.1, le=10000)]] = 3.0
    """Least distance flown before a scale is estimated, metres."""
    max_sigma_scale: Expert[Annotated[float, Meta(ge=0.001, le=1)]] = 0.1
    """Largest relative standard deviation of the scale."""


@dataclass(frozen=True, slots=True)
class OpenclConfig:
    """OpenCL device of the dense map; see docs/opencl.md."""

    device: str = "auto"
    """"auto" (the fastest that computes right), or a part of a device's or platform's name, or
    "platform:device" by number."""


@dataclass(frozen=True, slots=True)
class DepthConfig:
    """The dense map."""

    enabled: bool = True
    """Make the dense map; without it there are a trajectory and sparse points only."""
    stride: Expert[Annotated[int, Meta(ge=1, le=8)]] = 2
    """Pixel step of depth estimation; images are matched at full size."""
    reference_step: Expert[Annotated[float, Meta(ge=0, le=10)]] = 0.15
    """Least distance between keyframes with a depth map, as a share of the depth."""
    max_baseline: Expert[Annotated[float, Meta(ge=0.01, le=1)]] = 0.20
    """Longest baseline used, as a share of the median depth."""
    min_zncc: Expert[Annotated[float, Meta(ge=0, le=1)]] = 0.5
    """Least correlation (ZNCC) of a matching image."""
    converged_sigma: Expert[Annotated[float, Meta(ge=0.0001, le=0.1)]] = 0.02
    """Relative standard deviation at which a pixel has converged."""
    min_inlier_ratio: Expert[Annotated[float, Meta(ge=0, le=1)]] = 0.35
    """Least share of matching images of a converged pixel; some may not see it."""
    regularise_iterations: Expert[Annotated[int, Meta(ge=0, le=1000)]] = 60
    """Iterations of smoothing of a finished depth map; 0: none."""
    regularise_weight: Expert[Annotated[float, Meta(ge=0.001, le=1000)]] = 20.0
    """Weight of the measurements against smoothness."""


@dataclass(frozen=True, slots=True)
class CloudConfig:
    """The fused cloud."""

    voxel_m: Annotated[float, Meta(ge=0.001, le=100)] = 0.10
    """Voxel size of the cloud, metres; a hundredth of the median depth without a metric scale."""
    min_agreeing: Expert[Annotated[int, Meta(ge=0, le=4)]] = 2
    """Number of other keyframes whose depth must agree with a point's."""
    agreement: Expert[Annotated[float, Meta(ge=0.001, le=0.2)]] = 0.015
    """Largest relative difference of depths that agree."""
    memory_mb: Expert[Annotated[int, Meta(ge=1, le=100000)]] = 64
    """Points of a flight kept in memory; others are in the run's folder until it ends."""
