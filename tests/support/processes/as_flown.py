"""A recording replayed as it was flown: each gate gives again what it gave in flight."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.support.processes.program import Run, replay_here

ENOUGH = 150
"""Messages with poses, however long they take on a busy machine."""


def again(path: Path, out: Path, *options: str) -> tuple[Run, dict[str, Any]]:
    """The replay of a flight's folder, and its verdict: as_flown.json."""
    done = replay_here(path, out, "--as-flown", *options)
    assert done.status == 0, done.stdout + done.stderr
    found: dict[str, Any] = json.loads((out / "as_flown.json").read_text())
    for gate in found["by_gate"].values():
        assert gate["same"] == gate["sent"] == gate["made_again"]
    return done, found
