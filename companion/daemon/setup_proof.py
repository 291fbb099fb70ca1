"""Proof that the camera sits and sees as configured, and what the pilot reads without it.

On the ground a wrong mount or focal length looks like a right one, until the drone is turned. So
localisation says when turns have fitted, which is kept on disk for this camera and mount.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from companion.config import Config
from companion.daemon.pose.kept_counter import counter_path
from companion.geometry.camera import Camera
from companion.messages import Warned
from companion.pilot_messages import SETUP_UNPROVEN, PilotText
from companion.products.newest_file import NewestFile

NAME = "setup_proof.json"
MOUNT, LENS = "mount", "lens"
OF_WARNING = {
    "camera turns with the body as its mount says": MOUNT,
    "turns look as the focal length says": LENS,
}


class SetupProof:
    """Parts proven of the camera of now, and words to the pilot about the others.

    Used in the event loop. `tell` takes what the pilot reads, `failed` why it cannot be kept (in
    another thread). Without gyroscopes no lens can be proven, and of a camera on a gimbal nothing:
    that is not asked for.
    """

    def __init__(
        self, config: Config, tell: Callable[[PilotText], None], failed: Callable[[str], None]
    ) -> None:
        self._tell = tell
        self._file = NewestFile(counter_path(config.daemon.flights).with_name(NAME), failed)
        self._parts = (MOUNT, LENS) if "imu" in config.telemetry.use else (MOUNT,)
        self._camera: Camera | None = None
        self._identity = ""
        self._proven: set[str] = set()
        self._has_sent = False
        self._armed: bool | None = None

    @property
    def missing(self) -> list[str]:
        """Parts that are yet to be proven; none before a camera is known."""
        return [each for each in self._parts if self._identity and each not in self._proven]

    def take(self, warning: Warned) -> None:
        """Take a message of localisation: some are proof."""
        part = OF_WARNING.get(warning.what)
        if part is None or not self._identity or part in self._proven:
            return
        self._proven.add(part)
        kept = {"camera": self._identity, "proven": sorted(self._proven)}
        self._file.put(json.dumps(kept, indent=1).encode())

    def step(self, camera: Camera | None, sends: bool, armed: bool, is_wanted: bool = True) -> None:
        """Take the state of now; what is missing is said as poses are first sent, and at arming.

        Nothing is said where poses are not wanted, nor in the air, where the drone is not to be
        turned by hand: a process that begins there begins with `armed`.
        """
        if camera is not None and camera is not self._camera:
            self._camera, self._identity = camera, _identity_of(camera)
            self._proven = _kept(self._file.path, self._identity)
        arms = armed and self._armed is False
        is_due = arms or (sends and not armed and not self._has_sent)
        self._has_sent, self._armed = self._has_sent or sends, armed
        if is_due and is_wanted and self.missing:
            self._tell(SETUP_UNPROVEN(what=", ".join(self.missing)))

    def close(self, seconds: float) -> None:
        """Write what is not yet written; waits for it at most this long."""
        self._file.close(seconds)


def _identity_of(camera: Camera) -> str:
    """Digest of what makes directions of the camera directions of the body.

    "" where nothing can be proven: on a gimbal, and with an unknown mount (then no pose is sent).
    """
    if camera.gimbal is not None or camera.body_from_camera is None:
        return ""
    numbers = [
        *camera.lens.values(), *camera.coefficients,
        *np.round(camera.body_from_camera.rotation, 5).ravel().tolist(),
    ]  # fmt: skip
    text = f"{camera.distortion.value} " + " ".join(f"{each + 0.0:.5f}" for each in numbers)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _kept(path: Path, identity: str) -> set[str]:
    """Parts proven of this camera before; none where that is not known."""
    try:
        kept = json.loads(path.read_bytes())
        return set(kept["proven"]) if identity and kept["camera"] == identity else set()
    except (OSError, KeyError, TypeError, ValueError):
        return set()  # it is proven again
