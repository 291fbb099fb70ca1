"""Configuration of a node: its stages and its peers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from companion.config import Config
from companion.errors import InputError

TRACKING, DEPTH, CLOUD = "tracking", "depth", "cloud"
SETS = (frozenset({TRACKING}), frozenset({DEPTH, CLOUD}), frozenset({TRACKING, DEPTH, CLOUD}))
"""Sets of stages that a node can run: depth maps are too large for a link to the cloud."""


def with_stages(config: Config, stages: Sequence[str] | None, join: Sequence[str]) -> Config:
    """The configuration with the options applied; InputError for no valid node."""
    distributed = config.distributed
    if stages is not None:
        distributed = replace(distributed, enabled=True, stages=tuple(stages))
    if join:
        distributed = replace(distributed, enabled=True, connect=tuple(join))
    if frozenset(distributed.stages) not in SETS:
        raise InputError(
            f"expert.distributed.stages = {','.join(distributed.stages) or 'none'}: "
            "wanted tracking, or depth,cloud, or tracking,depth,cloud"
        )
    if TRACKING not in distributed.stages:
        if not distributed.enabled:
            raise InputError("stages without tracking: wanted distributed.enabled too")
        if not (distributed.connect or distributed.listen):
            raise InputError("--join ENDPOINT is missing: where the node with tracking is")
        if not config.depth.enabled:
            raise InputError("depth.enabled = false: there is nothing to do for --stages depth")
    return replace(config, distributed=distributed)
