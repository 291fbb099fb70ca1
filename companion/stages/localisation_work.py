"""Stage `localisation`: the camera's pose, always from the newest frame."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from companion.estimation.localisation import LocalisationStage
from companion.estimation.resumption.checkpoint import CheckpointError
from companion.estimation.site.site_use import SiteUse, contradiction, wrong_metres
from companion.messages import (
    Bytes,
    Frame,
    Georeferenced,
    MapTakenUp,
    MapUpdate,
    Message,
    SiteMapUsed,
    Warned,
)
from companion.products.array_file import ArrayFile
from companion.products.site_map_file import (
    SITE_MAP,
    map_path,
    read_site_map,
    write_site_map,
)
from companion.products.site_map_tables import SiteMapError
from companion.runtime.stage_protocol import Finish, KeepMap, SetLoadLevel, Setup
from companion.runtime.stage_work import Work
from companion.slam.compiled.compiling import cache_errors, shipped
from companion.stages.map_keeper import Kept, MapKeeper
from companion.timing.clock import since_boot_ns
from drivers.system.file_pages import give_back_library_pages
from drivers.system.heap import give_back_heap

KEEP_EVERY_NS = 1_000_000_000
NO_COLOUR = np.zeros((0, 0, 3), np.uint8)
MAP_NOT_USED = "the map of an earlier flight cannot be read"
MAP_DAMAGED = "the map of an earlier flight is damaged"
NOT_KEPT = "the map cannot be kept for a restart in flight"
IN_MEMORY = "the disk takes no more of the map, which grows in memory"


class _Localisation(Work):
    def __init__(self, setup: Setup) -> None:
        super().__init__()
        if shipped.why_unfit:
            print(
                f"companion: the package's compiled loops are not used ({shipped.why_unfit}): "
                "compiled here instead, and kept",
                file=sys.stderr,
            )
        if cache_errors:
            print(
                f"companion: {len(cache_errors)} compiled loops cannot be kept "
                f"({cache_errors[0]}): every start compiles them; NUMBA_CACHE_DIR names a folder "
                "for them",
                file=sys.stderr,
            )
        self._setup = setup
        self._said: list[tuple[str, str]] = []
        self._site_used: SiteMapUsed | None = None
        """Told with the first frame."""
        self._far = ArrayFile(setup.folder or Path(setup.config.daemon.flights))
        self._stage = LocalisationStage(
            setup.config, setup.camera, self.times, background=setup.is_live, site=self._site(setup)
        )
        self._stage.put_far_into(self._far)
        self._far.forget()
        self._is_far_fault_said = False
        if setup.is_live:  # in a process of its own; of the compiler of loops nothing is needed now
            give_back_heap()
            give_back_library_pages()
        self._keeper: MapKeeper | None = None
        self._to_take_up: Kept | None = None
        self._reported_fault = ""
        self._kept_ns = 0
        self._ahead: dict[int, Bytes] = {}
        """Images of frames to come that are begun with, by their number."""

    def _site(self, setup: Setup) -> SiteUse | None:
        """The site map to be used; SiteMapError of a replay, while a flight goes on without."""
        if not setup.config.map.use:
            return None
        path = map_path(setup.config.map.use).absolute()
        try:
            read = read_site_map(path, self._far)
            features = setup.config.features
            if (read.site.scale_factor, read.site.n_levels) != (
                features.scale_factor, features.n_levels,
            ):  # fmt: skip
                raise SiteMapError(
                    f"{setup.config.map.use}: it was made with features.scale_factor = "
                    f"{read.site.scale_factor:g} and n_levels = {read.site.n_levels}, and now they "
                    f"are {features.scale_factor:g} and {features.n_levels}"
                )
            if wrong := wrong_metres(read.site, setup.camera) or contradiction(read.site):
                raise SiteMapError(f"{setup.config.map.use}: {wrong}")
        except SiteMapError as error:
            if not setup.is_live:
                raise
            self._said.append((MAP_NOT_USED, str(error)))
            return None
        if setup.is_live:
            self._site_used = SiteMapUsed(0, str(path), read.site.revision, read.digest)
        if read.damaged:
            self._said.append((MAP_DAMAGED, f"{len(read.damaged)} parts are left out"))
        return SiteUse(read.site, setup.camera, setup.origin, setup.is_live, read.places)

    def step(self, message: Any) -> Iterable[Message]:
        if isinstance(message, SetLoadLevel):
            self._stage.set_effort(message.level)
            return []
        if isinstance(message, KeepMap):
            self._begin_keeping(message)
            return []
        if not isinstance(message, Frame):
            return self._stage.step(message)
        # the map keeps grey images for long, but nothing of the memory that a frame came in
        grey = self._ahead.pop(message.seq, None)
        if grey is None:
            grey = message.grey.copy()
        return self._frame(replace(message, grey=grey, rgb=NO_COLOUR))

    def look_ahead(self, frame: Frame) -> None:
        self._ahead[frame.seq] = grey = frame.grey.copy()
        self._stage.look_ahead(grey)

    def finish(self, finish: Finish) -> Iterable[Message]:
        if self._keeper is not None:
            self._keeper.close(forget=not finish.keep_map)
        yield from self._stage.finish(adjust=not finish.hurry)

    def save(self, finish: Finish) -> None:
        save = finish.save_map
        if save is None or finish.hurry:  # a disk may take longer than is left
            return
        site = self._stage.site_map(save.flight, save.origin)
        if site is None:
            return
        path = save.folder / SITE_MAP
        try:
            write_site_map(path, site)
        except OSError as error:
            why = error.strerror or str(error)
            print(f"companion: {path}: cannot be written: {why}", file=sys.stderr)

    def _begin_keeping(self, message: KeepMap) -> None:
        self._keeper = MapKeeper(message.path, self._setup)
        try:
            kept = self._keeper.take()
        except CheckpointError as error:
            print(f"companion: map checkpoint rejected: {error}", file=sys.stderr)
        else:
            self._to_take_up = kept if message.take_up else None

    def _frame(self, frame: Frame) -> Iterator[Message]:
        if self._to_take_up is not None:
            kept, tracked_ns, data = self._to_take_up
            self._to_take_up = None
            absent_ns = since_boot_ns() - tracked_ns
            self._stage.resume(kept, frame.t_ns, absent_ns)
            if self._setup.config.recorder.enabled:
                yield MapTakenUp(frame.t_ns, absent_ns, np.frombuffer(data, np.uint8))
        for what, detail in self._said:
            yield Warned(frame.t_ns, what, detail)
        self._said.clear()
        if self._site_used is not None:
            yield replace(self._site_used, t_ns=frame.t_ns)
            self._site_used = None
        for out in self._stage.step(frame):
            yield out
            if isinstance(out, MapUpdate):
                yield Georeferenced(out.t_ns, out.georeference)
        if self._far.fault and not self._is_far_fault_said:
            self._is_far_fault_said = True
            yield Warned(frame.t_ns, IN_MEMORY, self._far.fault)
        keeper = self._keeper
        if keeper is None or keeper.busy or frame.t_ns - self._kept_ns < KEEP_EVERY_NS:
            return
        if keeper.fault and keeper.fault != self._reported_fault:
            yield Warned(frame.t_ns, NOT_KEPT, keeper.fault)
        self._reported_fault = keeper.fault
        try:
            checkpoint = self._stage.checkpoint()
        except Exception as error:  # a bug in what is kept for later must not end the pose of now
            self._keeper = None
            keeper.close(forget=True)
            traceback.print_exc()
            yield Warned(frame.t_ns, NOT_KEPT, f"{type(error).__name__}: {error}")
            return
        if checkpoint is not None:
            self._kept_ns = frame.t_ns
            keeper.put(checkpoint)


work = _Localisation
"""The stage for a setup."""
