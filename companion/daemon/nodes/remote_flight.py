"""Dense mapping of a flight that is flown and tracked on another machine."""

from __future__ import annotations

import sys
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path

from companion.config import Config
from companion.config_file import command_shown, shown
from companion.daemon.flights.viewing import Viewing
from companion.daemon.nodes.kept_chunks import KeptChunks
from companion.dense.depth_stage import DepthStage
from companion.dense.device_takeover import Devices
from companion.geometry.camera import Camera
from companion.messages import DepthMap, MapUpdate, Message, PointChunk, Warned
from companion.products.flight_result import FlightResult, RunFacts
from companion.products.report.write_results import write_results
from companion.products.surroundings import peak_memory_mb, versions
from companion.streaming.viewer import FileViewer
from companion.timing.clock import StageTimes, monotonic_s
from companion.topics.envelope import Envelope
from companion.topics.keyframe_bundle import Bundle, MapMirror, frame_of
from companion.topics.message_codec import cloud_envelope, depth_envelope
from drivers.system.journal import WARNING, Journal

Publish = Callable[[str, Callable[[], Envelope]], None]
"""Takes a topic, and a function that makes its envelope."""
MOST_NUMBERS = 200
"""Most keyframes whose bundle number is remembered."""


class RemoteFlight:
    """Bundles in; depth maps and points to files, viewers and topics.

    A folder that has a cloud of the same flight is continued.
    """

    def __init__(
        self, config: Config, flight: str, camera: Camera, devices: Devices, folder: Path,
        publish: Publish, journal: Journal,
    ) -> None:  # fmt: skip
        self.flight, self.camera, self.folder = flight, camera, folder
        self.n_missed = 0
        """Bundles evicted before they could be fetched."""
        self._config, self._devices = config, devices
        self._publish, self._journal = publish, journal
        folder.mkdir(parents=True, exist_ok=True)
        self.kept = KeptChunks(folder)
        self._times = StageTimes()
        self._began_s = monotonic_s()
        self._depth = DepthStage(config.depth, config.cloud, camera, devices, self._times)
        self._result = FlightResult(folder, config.cloud.memory_mb)
        self._mirror = MapMirror()
        self._update: MapUpdate | None = None
        self._numbers: OrderedDict[int, tuple[str, int]] = OrderedDict()
        self._recording = FileViewer(config.viewer, camera, _free(folder), indexed=False)
        self._recording.__enter__()
        self._viewing: Viewing | None = None
        if config.stream.listen or config.daemon.viewer != "none":
            self._viewing = Viewing(config, camera, flight, self._warn)
        for kept in self.kept.found:
            self._show(kept.chunk)

    @property
    def n_points(self) -> int:
        """Points so far."""
        return self._result.n_points

    @property
    def n_depth_maps(self) -> int:
        """Depth maps made by this process."""
        return self._result.n_depth_maps

    def take(self, bundle: Bundle) -> None:
        """Process a bundle. StreamError for undecodable images; the rest of it counts."""
        for keyframe in bundle.keyframes:
            self._numbers[keyframe.keyframe_id] = (bundle.run, bundle.number)
        while len(self._numbers) > MOST_NUMBERS:
            self._numbers.popitem(last=False)
        frames = [frame_of(picture, self.camera) for picture in bundle.pictures]
        for picture, frame in zip(bundle.pictures, frames, strict=True):
            self._step(frame)
            self._result.take(frame)
            if picture.in_colour:
                self._look(frame)
        messages: list[Message] = [*bundle.tracks, *bundle.keyframes]
        for message in messages:
            self._step(message)
            self._show(message)
        if bundle.change is not None:
            self._update = self._mirror.take(bundle.change)
            self._show(self._update)
            self._step(self._update)

    def close(self, hurry: bool) -> None:
        """Complete open depth maps, and write all results; the page only without `hurry`.

        Where no map has come, nothing is known of the points' places: earlier results stay.
        """
        for out in self._depth.flush():
            self._give(out)
        self.kept.close()
        self._recording.__exit__(None, None, None)
        if self._viewing is not None:
            self._viewing.close(hurry)
        if self._update is not None:
            self._write(page=not hurry)
        self._result.close()

    def _write(self, page: bool) -> None:
        facts = RunFacts(
            stage_times=self._times.summary(), wall_s=monotonic_s() - self._began_s, clock=None,
            origin=None, device=self._devices.described, config=shown(self._config),
            versions=versions(), command=command_shown(sys.argv),
            peak_memory_mb=peak_memory_mb(), camera=self.camera,
            n_frames_total=self._result.n_frames, completed=True,
            dropped={"bundles": self.n_missed},
        )  # fmt: skip
        write_results(self.folder, self._result, facts, self._config.cloud.voxel_m, page=page)

    def _step(self, message: Message) -> None:
        for out in self._depth.step(message):
            self._give(out)

    def _give(self, message: Message) -> None:
        if isinstance(message, PointChunk):
            run, number = self._numbers.get(message.keyframe_id, ("", -1))
            if not self.kept.put(self.flight, message, run, number):
                return
            self._publish("cloud", lambda: cloud_envelope(self.flight, message, self._update))
        elif isinstance(message, DepthMap):
            self._publish("depth", lambda: depth_envelope(self.flight, message, self._update))
        elif isinstance(message, Warned):
            self._warn(message.what, message.detail, message.good)
        self._show(message)

    def _show(self, message: Message) -> None:
        self._result.take(message)
        self._look(message)

    def _look(self, message: Message) -> None:
        self._recording.take(message)
        if self._viewing is not None:
            self._viewing.take(message)

    def _warn(self, what: str, detail: str, good: bool) -> None:
        if good:
            self._journal.say(f"{what}: {detail}")
        else:
            self._journal.say(f"warning: {what}: {detail}", WARNING)


def _free(folder: Path) -> Path:
    """Path of a recording that does not exist yet."""
    names = ["flight.rrd", *(f"flight-{n}.rrd" for n in range(2, 1000))]
    return next(folder / name for name in names if not (folder / name).exists())
