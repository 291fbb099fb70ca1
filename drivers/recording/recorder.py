"""Recorder: writes the input and output of a flight as they come: flight.mcap, and flight.tlog."""

from __future__ import annotations

import struct
import threading
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from companion.config import Config
from companion.config.passwords import with_passwords_hidden
from companion.config_file import to_toml
from companion.errors import StageError
from companion.flight_notes import FlightNote, GateStep, HealthNote, LinkBytes, ObstaclePoints
from companion.geometry.camera import Camera
from companion.geometry.transforms import Similarity
from companion.messages import (
    Frame,
    FrameTracked,
    LandingTarget,
    MapTakenUp,
    MapUpdate,
    Message,
    Odometry,
    OpticalFlow,
    PointChunk,
    SiteMapUsed,
    Warned,
)
from companion.telemetry import Telemetry
from drivers.images.camera_document import camera_document
from drivers.mavlink.wire.packet_stream import MavlinkStream, Packet
from drivers.recording.disk_writer import DiskWriter, Entry
from drivers.recording.flights_folder import RECORDING, TLOG
from drivers.recording.growing_file import GrowingFile
from drivers.recording.mcap_writer import McapWriter
from drivers.recording.picture_codec import EncodedPicture, picture_encoder
from drivers.recording.recording_codec import (
    calibration_bytes,
    cloud_bytes,
    decision_bytes,
    event_bytes,
    json_bytes,
    link_bytes,
    map_of_before_bytes,
    obstacle_points_bytes,
    odometry_bytes,
    pose_bytes,
    sample_bytes,
    sample_topic,
)
from drivers.recording.recording_topics import (
    CALIBRATION,
    CLOUD,
    EVENTS,
    FLOW,
    GATES,
    HEALTH,
    LANDING,
    MAP_TAKEN_UP,
    OBSTACLE_POINTS,
    ODOMETRY,
    POSE,
    PROFILE,
    RECEIVED,
    SENT,
    SITE_MAP,
    TIMESYNC,
    TRACKING,
    open_channels,
)

CAMERA_JSON, CONFIG_TOML = "camera.json", "config.toml"
NOTES = "companion"
"""Metadata: versions and other facts known at the beginning."""
_DECISIONS = {FrameTracked: TRACKING, GateStep: GATES, SiteMapUsed: SITE_MAP}
_TIMESYNC_ID, _TIMES = 111, struct.Struct("<qq")
MOST_ROUND_TRIP_NS = 2_000_000_000


class Recorder:
    """Recording of one flight, in an existing folder. Used from one thread.

    StageError where it cannot be begun. Nothing waits for the disk but `close`.
    """

    def __init__(
        self, folder: Path, config: Config, camera: Camera, versions: Mapping[str, str]
    ) -> None:
        self._config = config.recorder
        self._warnings: list[Warned] = []
        self._lock = threading.Lock()
        self._newest_ns = 0
        self._streams = {False: MavlinkStream(), True: MavlinkStream()}
        self._map: MapUpdate | None = None
        self._camera: Camera | None = camera
        self._skips_until_intra = False
        self.n_frames = 0
        """Images received, written or not."""
        self._encoder = picture_encoder(
            self._config, camera.width, camera.height, config.camera.rate_hz
        )
        files: list[GrowingFile] = []
        try:
            files += [GrowingFile(folder / RECORDING), GrowingFile(folder / TLOG)]
            writer = McapWriter(files[0].append, PROFILE)
            self._channels = open_channels(writer)
            writer.attach(CAMERA_JSON, "application/json", camera_document(camera), 0)
            toml = to_toml(with_passwords_hidden(config)).encode()
            writer.attach(CONFIG_TOML, "application/toml", toml, 0)
            writer.note(NOTES, {**versions, "pictures": self._encoder.name, "flight": folder.name})
            self._disk = DiskWriter(
                self._config, files[0], writer, files[1], folder, lambda: self._newest_ns,
                self._warned,
            )  # fmt: skip
        except OSError as error:
            for file in files:
                file.discard()
            raise StageError(f"{folder}: cannot be recorded to: {error.strerror}") from error

    @property
    def n_dropped(self) -> Counter[str]:
        """Number of dropped messages, by kind."""
        return self._disk.n_dropped

    @property
    def slowest_s(self) -> float:
        """Longest time to write and sync a chunk."""
        return self._disk.slowest_s

    def take(self, message: Message | FlightNote) -> None:
        """Record a message; of the map only the points, and those if configured."""
        self._newest_ns = max(self._newest_ns, message.t_ns)
        if isinstance(message, LinkBytes):
            self._link(message)
        elif isinstance(message, Frame):
            self._frame(message)
        elif isinstance(message, Telemetry):
            self._put(sample_topic(message), message.t_ns, sample_bytes(message))
        elif isinstance(message, Odometry):
            self._put(ODOMETRY, message.t_ns, odometry_bytes(message), message.seq)
            pose = pose_bytes(message)
            if pose is not None:
                self._put(POSE, message.t_ns, pose, message.seq)
        elif isinstance(message, FrameTracked | GateStep | SiteMapUsed):
            self._put(_DECISIONS[type(message)], message.t_ns, decision_bytes(message))
        elif isinstance(message, LandingTarget | OpticalFlow):
            topic = LANDING if isinstance(message, LandingTarget) else FLOW
            self._put(topic, message.t_ns, decision_bytes(message), message.seq)
        elif isinstance(message, MapTakenUp):
            self._put(MAP_TAKEN_UP, message.t_ns, map_of_before_bytes(message))
        elif isinstance(message, ObstaclePoints):
            self._put(OBSTACLE_POINTS, message.t_ns, obstacle_points_bytes(message))
        elif isinstance(message, Warned):
            self._put(EVENTS, message.t_ns, event_bytes(message))
        elif isinstance(message, HealthNote):
            self._put(HEALTH, message.t_ns, json_bytes(message.document))
        elif isinstance(message, MapUpdate):
            self._map = message
        elif isinstance(message, PointChunk) and self._config.point_cloud:
            self._cloud(message)

    def warnings(self) -> list[Warned]:
        """Warnings since the last call."""
        with self._lock:
            out, self._warnings = self._warnings, []
        return out

    def close(self) -> None:
        """Complete the files."""
        self._put_pictures(self._encoder.finish())
        self._disk.close()

    def _frame(self, frame: Frame) -> None:
        if self._camera is not None:
            self._put(CALIBRATION, frame.t_ns, calibration_bytes(self._camera, frame.t_ns))
            self._camera = None
        self.n_frames += 1
        if not self._disk.recording:
            self._disk.n_dropped["pictures"] += 1
            return
        self._put_pictures(self._encoder.encode(frame))

    def _put_pictures(self, messages: list[EncodedPicture]) -> None:
        for topic, seq, t_ns, data, intra in messages:
            if self._skips_until_intra and not intra:
                self._disk.n_dropped["pictures"] += 1
                continue
            entry = Entry(self._channels[topic], t_ns, data, seq)
            self._skips_until_intra = not self._disk.put(entry, "pictures", is_picture=True)
            if self._skips_until_intra:
                self._encoder.request_intra()
                return  # a frame of two pictures is one that was dropped

    def _link(self, taken: LinkBytes) -> None:
        self._put(SENT if taken.outgoing else RECEIVED, taken.t_ns, link_bytes(taken))
        for packet in self._streams[taken.outgoing].feed(taken.data, taken.monotonic_ns):
            self._disk.put_packet(struct.pack(">Q", taken.t_ns // 1000) + packet.raw)
            if packet.message_id == _TIMESYNC_ID and packet.known and not taken.outgoing:
                self._exchange(packet, taken.t_ns)

    def _exchange(self, packet: Packet, received_ns: int) -> None:
        autopilot_ns, sent_ns = _TIMES.unpack_from(packet.payload.ljust(_TIMES.size, b"\0"))
        # an answer to another computer has that one's time in it, which is not ours
        if autopilot_ns and 0 <= received_ns - sent_ns <= MOST_ROUND_TRIP_NS:
            exchange = {
                "sent_ns": sent_ns, "autopilot_ns": autopilot_ns, "received_ns": received_ns
            }  # fmt: skip
            self._put(TIMESYNC, received_ns, json_bytes(exchange))

    def _cloud(self, chunk: PointChunk) -> None:
        place = self._map.place_of(chunk.keyframe_id) if self._map is not None else None
        if self._map is None or place is None:
            return
        found = self._map.georeference
        world: Similarity = place if found is None else found.world_from_map @ place
        self._put(CLOUD, chunk.t_ns, cloud_bytes(chunk, world, found is not None))

    def _put(self, topic: str, t_ns: int, data: bytes, sequence: int | None = None) -> None:
        self._disk.put(Entry(self._channels[topic], t_ns, data, sequence), "messages")

    def _warned(self, warning: Warned) -> None:
        with self._lock:
            self._warnings.append(warning)
