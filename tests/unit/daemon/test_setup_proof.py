"""A mount or lens that nothing has proven is said before the motors are armed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from companion.config_file import load_config
from companion.daemon.setup_proof import NAME, OF_WARNING, SetupProof
from companion.estimation.attitude.camera_attitude import MOUNT_FITS
from companion.estimation.lens.lens_watch import LENS_FITS
from companion.geometry.camera import Camera
from companion.geometry.gimbal import Gimbal
from companion.geometry.transforms import Pose, rotation_from_vector
from companion.messages import Warned
from companion.pilot_messages import PilotText

TURNED = Pose(rotation_from_vector(np.array([0.1, -0.7, 0.2])), np.array([0.1, 0.0, 0.05]))
OTHERWISE = Pose(rotation_from_vector(np.array([0.1, -0.8, 0.2])), np.zeros(3))
CAMERA = Camera(640, 480, 480.0, 481.0, 320.0, 240.0, body_from_camera=TURNED)
PREFIX = "Companion: "


class Power:
    """The daemon from one power-on to the next, as far as it concerns proof."""

    def __init__(self, folder: Path, *overrides: str) -> None:
        config = load_config(None, [f"daemon.flights={folder / 'flights'}", *overrides])
        self.said: list[str] = []
        self.proof = SetupProof(config, self._tell, pytest.fail)

    def _tell(self, text: PilotText) -> None:
        self.said.append(text.text.removeprefix(PREFIX))

    def flies(self, camera: Camera = CAMERA) -> list[str]:
        """What the pilot reads from power-on to the second arming, and the power is off."""
        for sends, armed in ((False, False), (True, False), (True, False), (True, True),
                             (True, True), (True, False), (True, True)):  # fmt: skip
            self.proof.step(camera, sends, armed)
        self.proof.close(10.0)
        return self.said

    def hears(self, *whats: str) -> None:
        """Turned by hand, which gives these messages; and the power is off."""
        self.proof.step(CAMERA, False, False)
        for what in whats:
            self.proof.take(Warned(1, what, good=True))
        self.proof.close(10.0)


def test_it_is_said_as_poses_begin_and_at_each_arming(tmp_path: Path) -> None:
    assert Power(tmp_path).flies() == ["mount, lens unproven: turn it by hand"] * 3


def test_nothing_is_said_in_the_air(tmp_path: Path) -> None:
    """Of a process that was started again there, until the next arming."""
    power = Power(tmp_path)
    for sends in (False, True, False, True):
        power.proof.step(CAMERA, sends, armed=True)
    assert power.said == [] and power.proof.missing == ["mount", "lens"]
    power.proof.step(CAMERA, True, armed=False)
    power.proof.step(CAMERA, True, armed=True)
    power.proof.close(10.0)
    assert power.said == ["mount, lens unproven: turn it by hand"]


def test_it_is_proven_without_a_word_where_poses_are_not_wanted(tmp_path: Path) -> None:
    power = Power(tmp_path)
    for armed in (False, True):
        power.proof.step(CAMERA, False, armed, is_wanted=False)
    for what in (MOUNT_FITS, LENS_FITS):
        power.proof.take(Warned(1, what, good=True))
    power.proof.close(10.0)
    assert power.said == [] and Power(tmp_path).flies() == []


def test_what_was_proven_is_known_after_the_next_power_on(tmp_path: Path) -> None:
    Power(tmp_path).hears("map resumed after restart", MOUNT_FITS)
    assert Power(tmp_path).flies() == ["lens unproven: turn it by hand"] * 3
    Power(tmp_path).hears(LENS_FITS)
    third = Power(tmp_path)
    assert third.flies() == [] and third.proof.missing == []


@pytest.mark.parametrize("other", [
    replace(CAMERA, fx=470.0),
    replace(CAMERA, body_from_camera=OTHERWISE),
])  # fmt: skip
def test_another_mount_or_lens_is_proven_anew(other: Camera, tmp_path: Path) -> None:
    Power(tmp_path).hears(MOUNT_FITS, LENS_FITS)
    assert len(Power(tmp_path).flies(other)) == 3
    moved = replace(CAMERA, body_from_camera=Pose(TURNED.rotation, np.zeros(3)))
    assert Power(tmp_path).flies(moved) == [], "the lever arm shows in no turn"


def test_it_is_not_asked_for_what_cannot_be_proven(tmp_path: Path) -> None:
    without_imu = Power(tmp_path, 'telemetry.use=["attitude", "height"]')
    assert set(without_imu.flies()) == {"mount unproven: turn it by hand"}
    assert Power(tmp_path).flies(replace(CAMERA, gimbal=Gimbal())) == []
    assert Power(tmp_path).flies(replace(CAMERA, body_from_camera=None)) == []


@pytest.mark.parametrize("content", [b"", b"[1]", b'{"camera": 3}', b"\xff\x00"])
def test_a_damaged_file_proves_nothing(content: bytes, tmp_path: Path) -> None:
    (tmp_path / NAME).write_bytes(content)
    assert len(Power(tmp_path).flies()) == 3
    Power(tmp_path).hears(MOUNT_FITS, LENS_FITS)
    assert Power(tmp_path).flies() == []


def test_localisation_says_what_is_proof() -> None:
    assert set(OF_WARNING) == {MOUNT_FITS, LENS_FITS}
