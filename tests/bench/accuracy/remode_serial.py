"""REMODE's depth filter on one core, in C; compiled on demand by the system's compiler."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.errors import InputError
from companion.geometry.transforms import Pose
from companion.messages import Bytes, Floats

FLAGS = ("-O2", "-std=gnu99", "-shared", "-fPIC")
CONVERGED = 1


class RemodeSerial:
    """One reference image's filter; depths are euclidean distances. `close` when done.

    InputError where there is no C compiler.
    """

    def __init__(
        self,
        grey: Bytes,
        intrinsics: tuple[float, float, float, float],
        nearest: float,
        farthest: float,
    ) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="companion-")
        self._library = _compile(Path(self._folder.name))
        self._shape = grey.shape
        height, width = grey.shape
        camera = np.array(intrinsics, np.float32)
        self._filter = ctypes.c_void_p(
            self._library.remode_begin(
                _at(_unit(grey)), width, height, _at(camera), ctypes.c_float(nearest),
                ctypes.c_float(farthest),
            )
        )  # fmt: skip
        if not self._filter:
            raise MemoryError("no memory for the serial reference")

    def update(self, grey: Bytes, current_from_reference: Pose) -> None:
        """Take another image (H, W)."""
        forth = current_from_reference.matrix()[:3].astype(np.float32)
        back = current_from_reference.inverse().matrix()[:3].astype(np.float32)
        self._library.remode_update(self._filter, _at(_unit(grey)), _at(forth), _at(back))

    def state(self) -> tuple[Floats, NDArray[np.bool_]]:
        """Distances (H, W), and the mask (H, W) of converged pixels."""
        distance, state = np.zeros(self._shape, np.float32), np.zeros(self._shape, np.uint8)
        self._library.remode_state(self._filter, _at(distance), _at(state))
        return distance, state == CONVERGED

    def denoised(self) -> Floats:
        """Distances (H, W) after total variation denoising."""
        smooth = np.zeros(self._shape, np.float32)
        if not self._library.remode_denoise(self._filter, _at(smooth)):
            raise MemoryError("no memory for the serial reference")
        return smooth

    def close(self) -> None:
        """Free its memory."""
        self._library.remode_free(self._filter)
        self._folder.cleanup()


def _compile(folder: Path) -> ctypes.CDLL:
    compiler = next((c for c in ("cc", "gcc", "clang") if shutil.which(c)), None)
    if compiler is None:
        raise InputError(
            "the serial reference needs a C compiler: apt install gcc, or leave it out, by "
            "--no-serial"
        )
    out = folder / "remode_serial.so"
    source = Path(__file__).with_name("remode_serial.c")
    done = subprocess.run(
        [compiler, *FLAGS, "-o", str(out), str(source), "-lm"], capture_output=True, text=True
    )
    if done.returncode != 0:
        raise InputError(f"{source}: {compiler} cannot compile it: {done.stderr.strip()[:200]}")
    library = ctypes.CDLL(str(out))
    library.remode_begin.restype = ctypes.c_void_p
    return library


def _unit(grey: Bytes) -> Floats:
    return np.ascontiguousarray(grey, np.float32) / np.float32(255)


def _at(array: NDArray[Any]) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)
