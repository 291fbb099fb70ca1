"""Compile all loops for any processor of this architecture: python -m companion.slam.compiled.ship.

The code goes where an installed package is read from, which building one does once; a start then
compiles nothing (`shipped_code`).
"""

from __future__ import annotations

import os
import sys

os.environ["NUMBA_CPU_NAME"] = "generic"  # before numba is imported: it reads them once
os.environ["NUMBA_CPU_FEATURES"] = ""

import importlib
import pkgutil
import shutil

from companion.slam import compiled
from companion.slam.compiled import shipped_code


def main() -> int:
    """Write the code of all loops beside them; the exit status."""
    shutil.rmtree(shipped_code.FOLDER, ignore_errors=True)  # what is loaded cannot be written
    from companion.slam.compiled import compiling

    compiling.may_copy = False  # what was loaded from a cache cannot be written again
    for module in pkgutil.iter_modules(compiled.__path__):
        importlib.import_module(f"{compiled.__name__}.{module.name}")
    code = compiling.code_of_loops()
    shipped_code.write(shipped_code.FOLDER, code, compiling.HERE)
    size_kb = sum(map(len, code.values())) >> 10
    architecture = compiling.HERE["architecture"]
    print(f"{shipped_code.FOLDER}: {len(code)} loops for any {architecture}, {size_kb} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
