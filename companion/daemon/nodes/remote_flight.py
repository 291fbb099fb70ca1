"""Dense mapping of a flight that is flown and tracked on another machine."""

from __future__ import annotations

import sys
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path

from companion.config import Config
from companion.config.passwords import command_shown
from companion.config_file import shown
from companion.daemon.nodes.kept_chunks import KeptChunks
from companion.daemon.nodes.remote_viewing import RemoteViewing
from companion.geometry.camera import Camera
from companion.messages import DepthMap, MapUpdate, Message, PointChunk, Warned
from companion.messages.run_facts import RunFacts
from companion.products.versions import versions
from companion.runtime.in_order import InOrder
from companion.runtime.peak_memory import peak_memory_mb
from companion.runtime.stage_protocol import Finish, Setup
from companion.runtime.stages import Stage, stage_named
from companion.timing.clock import monotonic_s
from companion.topics.envelope import Envelope
from companion.topics.keyframe_bundle import Bundle, MapMirror, frame_of
from companion.topics.message_codec import cloud_envelope, depth_envelope
from drivers.system.journal import WARNING, Journal

Publish = Callable[[str, Callable[[], Envelope]], None]
"""Takes a topic, and a function that makes its envelope."""
STAGES = ("depth", "results")
MOST_NUMBERS = 200
"""Most keyframes whose bundle number is remembered."""


class RemoteFlight:
    """Bundles in; depth maps and points to files, viewers and topics.

    A folder that has a cloud of the same flight is continued.
    """

    def __init__(
        self, config: Config, flight: str, camera: Camera, folder: Path, publish: Publish,
        journal: Journal,
    ) -> None:  # fmt: skip
        self.flight, self.camera, self.folder = flight, camera, folder
        self.n_missed = 0
        """Bundles evicted before they could be fetched."""
        self.n_points = self.n_depth_maps = 0
        """Points so far, and depth maps made by this process."""
        self._config, self._publish, self._journal = config, publish, journal
        folder.mkdir(parents=True, exist_ok=True)
        self.kept = KeptChunks(folder)
        self._began_s = monotonic_s()
        self._n_frames = 0
        self._mirror = MapMirror()
        self._update: MapUpdate | None = None
        self._is_new = False
        """True while new points are made; those found in the folder come first."""
        self._numbers: OrderedDict[int, tuple[str, int]] = OrderedDict()
        self._viewing: RemoteViewing | None = None
        if config.stream.listen or config.daemon.viewer != "none":
            self._viewing = RemoteViewing(config, camera, flight, self._warn)
        setup = Setup(config, camera, folder, _free(folder), is_live=False)
        self._stages = InOrder(map(stage_named, STAGES), setup, self._watch, journal.say)
        for kept in self.kept.found:
            self._stages.feed(kept.chunk)
        self._is_new = True

    def take(self, bundle: Bundle) -> None:
        """Process a bundle. StreamError for undecodable images; the rest of it counts."""
        for keyframe in bundle.keyframes:
            self._numbers[keyframe.keyframe_id] = (bundle.run, bundle.number)
        while len(self._numbers) > MOST_NUMBERS:
            self._numbers.popitem(last=False)
        messages: list[Message] = [frame_of(each, self.camera) for each in bundle.pictures]
        self._n_frames += len(messages)
        messages += [*bundle.tracks, *bundle.refined, *bundle.keyframes]
        if bundle.change is not None:
            self._update = self._mirror.take(bundle.change)
            messages.append(self._update)
        for message in messages:
            self._stages.feed(message)

    def step(self) -> None:
        """Pass on what was made since the last bundle; to be called often."""
        self._stages.collect()
        if self._viewing is not None:
            self._viewing.step()

    def close(self, hurry: bool) -> None:
        """Complete open depth maps, and write all results; the page only without `hurry`.

        Where no map has come, nothing is known of the points' places: earlier results stay.
        """

        def finish(stage: Stage) -> Finish:
            writes = stage.name == "results" and self._update is not None
            return Finish(hurry, self._facts() if writes else None)

        self._stages.finish(finish)
        self.kept.close()
        if self._viewing is not None:
            self._viewing.close(hurry)

    def _facts(self) -> RunFacts:
        return RunFacts(
            stage_times=self._stages.times, wall_s=monotonic_s() - self._began_s, clock=None,
            origin=None, device=self._stages.progress("depth").device, config=shown(self._config),
            versions=versions(), command=command_shown(sys.argv),
            peak_memory_mb=peak_memory_mb(), camera=self.camera, n_frames_total=self._n_frames,
            completed=True, dropped={"bundles": self.n_missed},
        )  # fmt: skip

    def _watch(self, message: Message) -> bool:
        """Publish and show; False for points of a keyframe that has some already."""
        if isinstance(message, PointChunk):
            if self._is_new and not self._keep(message):
                return False
            self.n_points += len(message.points_camera)
        elif isinstance(message, DepthMap):
            self.n_depth_maps += 1
            self._publish("depth", lambda: depth_envelope(self.flight, message, self._update))
        elif isinstance(message, Warned):
            self._warn(message.what, message.detail, message.good)
        if self._viewing is not None:
            self._viewing.take(message)
        return True

    def _keep(self, chunk: PointChunk) -> bool:
        run, number = self._numbers.get(chunk.keyframe_id, ("", -1))
        is_first = self.kept.put(self.flight, chunk, run, number)
        if is_first:
            self._publish("cloud", lambda: cloud_envelope(self.flight, chunk, self._update))
        return is_first

    def _warn(self, what: str, detail: str, good: bool) -> None:
        if good:
            self._journal.say(f"{what}: {detail}")
        else:
            self._journal.say(f"warning: {what}: {detail}", WARNING)


def _free(folder: Path) -> str:
    """Name of a recording that does not exist yet."""
    names = ["flight.rrd", *(f"flight-{n}.rrd" for n in range(2, 1000))]
    return next(name for name in names if not (folder / name).exists())
