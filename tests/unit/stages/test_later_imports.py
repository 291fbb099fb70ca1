"""What localisation imports before the first pose, and what beside it."""

from __future__ import annotations

import subprocess
import sys

from companion.stages.later_imports import LATER

BEGUN = f"""
import sys
from companion.stages import later_imports, localisation_work
loaded = [name for name in {LATER!r} if name in sys.modules]
later_imports.AFTER_S = 0.0
later_imports.import_later().join()
print(loaded, [name for name in {LATER!r} if name not in sys.modules])
"""


def test_later_imports_are_made_later() -> None:
    done = subprocess.run(
        [sys.executable, "-c", BEGUN], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "[] []\n"
