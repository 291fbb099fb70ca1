"""Installation of an OpenCL driver: the script with stand-ins for system commands."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[3] / "packaging/opencl.sh"


class Computer:
    """A folder of commands that log their calls, ahead of the real ones."""

    def __init__(self, folder: Path) -> None:
        self.venv, self.commands, self.log = folder / "venv", folder / "bin", folder / "calls"
        self.beside = self.venv / "lib/python3.11/site-packages/pyopencl/.libs"
        self.beside.mkdir(parents=True)
        self.works = folder / "works"
        (self.venv / "bin").mkdir()
        self.commands.mkdir()
        self.command("companion", f'[ -e "{self.works}" ]', self.venv / "bin")
        self.command("id", "echo 1000")
        self.command("sudo", "exit 1")
        self.command("apt-get", "exit 1")
        self.command("uname", "echo x86_64")
        self.command("python", "exit 1", self.venv / "bin")

    def command(self, name: str, does: str, folder: Path | None = None) -> None:
        path = (folder or self.commands) / name
        path.write_text(f'#!/bin/sh\necho "{name} $*" >>"{self.log}"\n{does}\n')
        path.chmod(0o755)

    def pip_brings_intel(self, then: str) -> None:
        library = self.venv / "lib/libintelocl.so"
        self.command("python", f'touch "{library}"; {then}', self.venv / "bin")

    def run(self) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ["sh", str(SCRIPT), str(self.venv)], capture_output=True, text=True, timeout=60,
            env={**os.environ, "PATH": f"{self.commands}:{os.environ['PATH']}"}, check=False,
        )  # fmt: skip

    def called(self, what: str) -> bool:
        return any(line.startswith(what) for line in self.log.read_text().splitlines())


@pytest.fixture
def computer(tmp_path: Path) -> Computer:
    return Computer(tmp_path)


def test_nothing_is_installed_where_a_device_works(computer: Computer) -> None:
    computer.works.touch()
    done = computer.run()
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert not computer.called("apt-get") and not computer.called("python")


@pytest.mark.parametrize("root", [True, False])
def test_packages_are_installed_where_they_may_be(computer: Computer, root: bool) -> None:
    if root:
        computer.command("id", "echo 0")
    else:
        computer.command("sudo", 'shift; "$@"')
    computer.command("apt-get", f'case "$*" in *install*) touch "{computer.works}";; esac')
    done = computer.run()
    assert done.returncode == 0
    assert len(done.stdout.splitlines()) == 1 and "pocl-opencl-icd" in done.stdout
    assert computer.called("apt-get install") and not computer.called("python")
    assert computer.called("sudo") is not root


def test_without_rights_intels_runtime_goes_into_the_environment(computer: Computer) -> None:
    computer.pip_brings_intel(f'touch "{computer.works}"')
    done = computer.run()
    assert done.returncode == 0
    assert len(done.stdout.splitlines()) == 1 and "Intel" in done.stdout
    assert not computer.called("apt-get")
    assert computer.called("python -m pip install")
    named = (computer.beside / "intel.icd").read_text().strip()
    assert named == str(computer.venv / "lib/libintelocl.so")


def test_packages_that_give_no_device_are_followed_by_intels_runtime(computer: Computer) -> None:
    computer.command("id", "echo 0")
    computer.command("apt-get", "exit 0")
    computer.pip_brings_intel(f'touch "{computer.works}"')
    assert computer.run().returncode == 0
    assert computer.called("apt-get install") and computer.called("python -m pip install")


@pytest.mark.parametrize("machine", ["x86_64", "aarch64"])
def test_where_nothing_helps_it_says_what_to_type(computer: Computer, machine: str) -> None:
    computer.command("uname", f"echo {machine}")
    done = computer.run()
    assert done.returncode == 1
    assert "Type: sudo apt install pocl-opencl-icd" in done.stderr
    assert computer.called("python") is (machine == "x86_64")
