"""The process of a tiny stage, as companion.runtime.stage_child is that of a real one."""

from __future__ import annotations

import os
import sys

from companion.runtime import stage_child, stages
from tests.support.processes import tiny_stages

stage_child.REPORT_EVERY_S = 0.05
stages.STAGES = (*tiny_stages.STAGES, tiny_stages.LEFT_OVER)  # type: ignore[assignment]
for stage in stages.STAGES:
    sys.modules[f"companion.stages.{stage.name}_work"] = tiny_stages

if __name__ == "__main__":
    os._exit(stage_child.main())
