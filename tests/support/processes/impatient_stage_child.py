"""The process of a stage that waits less long for the driver of a proven OpenCL device."""

from __future__ import annotations

import os
import sys

from companion.runtime import stage_child
from companion.stages import depth_work

depth_work.PATIENCE_S = 8.0

if __name__ == "__main__":
    status = stage_child.main()
    sys.stderr.flush()
    os._exit(status)
