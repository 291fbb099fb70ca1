"""Configuration: all sections and keys, with defaults.

Each section is a frozen dataclass; a stage takes its own section only. The text below a key says
what it is for; `config/companion.toml` and docs/settings.md are made of these texts. A key marked
`Expert` is set under `[expert.SECTION]`. `Meta` and `Literal` give the valid values, which are
checked where a configuration is read (`companion.config_file`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

from companion.config.autopilot_settings import (
    ControlConfig,
    FeedbackConfig,
    GpsConfig,
    LandingConfig,
    LinkConfig,
    RouterConfig,
    TelemetryConfig,
)
from companion.config.camera_settings import CameraConfig, MountConfig
from companion.config.computer_settings import ComputerConfig
from companion.config.flight_settings import DaemonConfig, ExportConfig, MapConfig, RecorderConfig
from companion.config.mapping_settings import (
    CloudConfig,
    DepthConfig,
    FeaturesConfig,
    GeoreferenceConfig,
    OpenclConfig,
    TrackingConfig,
)
from companion.config.network_settings import (
    DistributedConfig,
    PageConfig,
    StreamConfig,
    VideoConfig,
    ViewerConfig,
)
from companion.config.setting_kinds import ADDRESS, EXPERT, MEASUREMENTS, Expert, Measurement

__all__ = [
    "ADDRESS", "EXPERT", "MEASUREMENTS", "CameraConfig", "CloudConfig", "ComputerConfig", "Config",
    "ControlConfig", "DaemonConfig", "DepthConfig", "DistributedConfig", "Expert", "ExportConfig",
    "FeaturesConfig", "FeedbackConfig", "GeoreferenceConfig", "GpsConfig", "LandingConfig",
    "LinkConfig", "MapConfig", "Measurement", "MountConfig", "OpenclConfig", "PageConfig",
    "RecorderConfig", "RouterConfig", "StreamConfig", "TelemetryConfig", "TrackingConfig",
    "VideoConfig", "ViewerConfig",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Config:
    """All sections."""

    computer: ComputerConfig = field(default_factory=ComputerConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    mount: MountConfig = field(default_factory=MountConfig)
    link: LinkConfig = field(default_factory=LinkConfig)
    router: RouterConfig = field(default_factory=RouterConfig)
    feedback: FeedbackConfig = field(default_factory=FeedbackConfig)
    landing: LandingConfig = field(default_factory=LandingConfig)
    gps: GpsConfig = field(default_factory=GpsConfig)
    control: ControlConfig = field(default_factory=ControlConfig)
    daemon: DaemonConfig = field(default_factory=DaemonConfig)
    recorder: RecorderConfig = field(default_factory=RecorderConfig)
    telemetry: TelemetryConfig = field(default_factory=TelemetryConfig)
    features: FeaturesConfig = field(default_factory=FeaturesConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    georeference: GeoreferenceConfig = field(default_factory=GeoreferenceConfig)
    map: MapConfig = field(default_factory=MapConfig)
    opencl: OpenclConfig = field(default_factory=OpenclConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)
    cloud: CloudConfig = field(default_factory=CloudConfig)
    stream: StreamConfig = field(default_factory=StreamConfig)
    page: PageConfig = field(default_factory=PageConfig)
    video: VideoConfig = field(default_factory=VideoConfig)
    distributed: DistributedConfig = field(default_factory=DistributedConfig)
    viewer: ViewerConfig = field(default_factory=ViewerConfig)
    export: ExportConfig = field(default_factory=ExportConfig)
