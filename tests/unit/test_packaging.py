"""The scripts of packaging/: their syntax, and that the tests which one of them names are there."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EMULATED = ROOT / "packaging/test_aarch64.sh"
SCRIPTS = sorted(
    [*ROOT.glob("packaging/*.sh"), *(ROOT / "packaging/deb" / each
                                     for each in ("postinst", "prerm", "postrm"))]
)  # fmt: skip


def quoted(name: str) -> str:
    """What a variable of several lines holds in the script of the emulated tests."""
    found = re.search(rf"^{name}='\n(.*?)'$", EMULATED.read_text("utf-8"), re.M | re.S)
    assert found is not None
    return found[1]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_a_shell_can_read_it(script: Path) -> None:
    done = subprocess.run(
        ["sh", "-n", str(script)], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_emulated_tests_are_there() -> None:
    named = quoted("tests").split()
    assert named
    assert not [path for path in named if not (ROOT / path).exists()]


def test_tests_left_out_under_emulation_are_there_and_have_a_reason() -> None:
    for line in quoted("left_out").splitlines():
        test, _, reason = line.partition(" ")
        file, _, name = test.partition("::")
        assert (ROOT / file).is_file() and reason.strip(), line
        assert not name or f"def {name.partition('[')[0]}(" in (ROOT / file).read_text("utf-8")


def test_emulated_tests_say_what_is_wrong_with_an_option(tmp_path: Path) -> None:
    done = subprocess.run(
        ["sh", str(EMULATED), "--in-namespace", "--bind", str(tmp_path / "missing"), str(tmp_path)],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr == f"test_aarch64.sh: --bind {tmp_path}/missing: there is nothing\n"


def test_container_is_given_what_it_copies() -> None:
    """Each COPY of the build names something that is there and not left out."""
    text = (ROOT / "packaging/Containerfile").read_text("utf-8")
    wanted = [
        path
        for line in re.findall(r"^COPY (?!--from)(.+) \S+$", text, re.M)
        for path in line.split()
    ]
    kept = {
        line[1:] for line in (ROOT / ".containerignore").read_text("utf-8").splitlines()
        if line.startswith("!")
    }  # fmt: skip
    assert len(wanted) > 5
    for path in wanted:
        assert (ROOT / path).exists(), path
        assert any(path == each or path.startswith(f"{each}/") for each in kept), path


def test_wheel_has_the_sample_flight() -> None:
    settings = (ROOT / "pyproject.toml").read_text("utf-8")
    for source, place in re.findall(r'^"(sample/[^"]+)" = "(companion/[^"]+)"$', settings, re.M):
        assert (ROOT / source).is_file()
        assert place == f"companion/{source}"
    assert settings.count('= "companion/sample/survey/') == 4
