"""Drop policies of messages that wait for a stage, and the size of its queues."""

from __future__ import annotations

from typing import Any

from companion.messages import DepthMap, Frame, MapUpdate, PointChunk
from companion.runtime.frame_ring import FrameHandle
from companion.runtime.mailbox import DropPolicy
from companion.runtime.stage_protocol import Finish, SetLoadLevel, Setup, TakeSnapshot

OUT_BYTES = 32 << 20
"""Queue before a stage, in the daemon, where frames are handles: six depth maps of 640x480."""
IN_BYTES = 64 << 20
"""Queue in a stage's process, where frames are copies: fifty of 640x480."""
FRAMES_SHARE = 0.6
"""Share of that capacity for frames; the rest is for other messages."""


def drop_policy_of(message: Any, latest_only: bool) -> DropPolicy:
    """Drop policy of a message; `latest_only` for a stage that wants the newest frame only."""
    if isinstance(message, FrameHandle):
        return DropPolicy.LATEST_WINS if latest_only else DropPolicy.LOSSLESS
    if isinstance(message, Frame | DepthMap):
        return DropPolicy.PICTURE
    if isinstance(message, PointChunk | MapUpdate):
        return DropPolicy.MAP
    if isinstance(message, Setup | Finish | SetLoadLevel | TakeSnapshot):
        return DropPolicy.ALWAYS
    return DropPolicy.LOSSLESS
