"""What of the messages for a stage gives way, and how much of them may wait."""

from __future__ import annotations

from typing import Any

from companion.messages import DepthMap, Frame, MapUpdate, PointChunk
from companion.runtime.frame_ring import FrameInRing
from companion.runtime.mailbox import Fate
from companion.runtime.stage_protocol import Finish, SetShare, Setup, TakeSnapshot

OUT_BYTES = 32 << 20
"""Before a stage, in the daemon, where frames are a few bytes: six depth maps of 640x480."""
IN_BYTES = 64 << 20
"""In a stage's process, where frames have been copied: fifty of 640x480."""
FRAMES_SHARE = 0.6
"""Of that room, for frames: what else comes needs some, too."""


def fate_of(message: Any, latest_only: bool) -> Fate:
    """`latest_only` is for who wants the latest frame and no other."""
    if isinstance(message, FrameInRing):
        return Fate.LATEST_WINS if latest_only else Fate.LOSSLESS
    if isinstance(message, Frame | DepthMap):
        return Fate.PICTURE
    if isinstance(message, PointChunk | MapUpdate):
        return Fate.MAP
    if isinstance(message, Setup | Finish | SetShare | TakeSnapshot):
        return Fate.ALWAYS
    return Fate.LOSSLESS
