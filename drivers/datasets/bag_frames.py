"""Static transforms between the frames of a bag."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Any

from companion.geometry.transforms import Pose
from drivers.datasets.bag_samples import pose_of_transform


class StaticFrames:
    """Forest of frames, from /tf_static."""

    def __init__(self) -> None:
        self._next: dict[str, dict[str, Pose]] = {}

    def take(self, message: Any) -> None:
        """Take a TFMessage."""
        for stamped in message.transforms:
            parent_from_child = pose_of_transform(stamped.transform)
            if parent_from_child is None:
                continue
            parent, child = _plain(stamped.header.frame_id), _plain(stamped.child_frame_id)
            self._next.setdefault(parent, {})[child] = parent_from_child
            self._next.setdefault(child, {})[parent] = parent_from_child.inverse()

    def between(self, a: str, b: str) -> Pose | None:
        """Transform `a_from_b`; None where they are not connected."""
        a, b = _plain(a), _plain(b)
        reached = {a: Pose.identity()}
        waiting = deque([a])
        while waiting:
            here = waiting.popleft()
            if here == b:
                return reached[b]
            for frame, here_from_frame in self._next.get(here, {}).items():
                if frame not in reached:
                    reached[frame] = reached[here] @ here_from_frame
                    waiting.append(frame)
        return None

    def first_known(self, names: Iterable[str]) -> str | None:
        """First of these frames that has a transform."""
        return next((name for name in names if _plain(name) in self._next), None)


def _plain(name: str) -> str:
    return name.lstrip("/")
