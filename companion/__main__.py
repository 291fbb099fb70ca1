"""`companion` and `python -m companion`."""

from __future__ import annotations

import os
import sys

# Before numpy loads: its matrices here are small, and threads of its own would take the cores
# from the stages that run side by side, and let sums come out in another order.
for variable in (
    "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM",
):  # fmt: skip
    os.environ.setdefault(variable, "1")
# OpenCV would load an OpenCL driver with its compiler, 40 MB, for what it then does not do
os.environ.setdefault("OPENCV_OPENCL_RUNTIME", "disabled")

from companion.app.cli import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
