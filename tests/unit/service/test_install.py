"""Installation steps; the installed service is tested in tests/system."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from companion.errors import InputError, InstallError
from companion.service.environment import why_unfit
from companion.service.install import install
from companion.service.install_paths import user_places
from companion.service.shipped import shipped, unit_for
from companion.service.steps import Step, carry_out, command, file_written, removed


def test_what_is_done_is_left_and_the_rest_is_done(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "deep/er/there"
    here.write_bytes(b"as it is")
    told: list[str] = []
    steps = [file_written(here, b"as it is"), file_written(there, b"new", 0o640)]
    carry_out(steps, told.append, dry_run=True)
    assert told == [f"already done: {here}", f"would do: {there}"]
    assert not there.parent.exists()
    told.clear()
    for _ in range(2):
        carry_out(steps, told.append, dry_run=False)
    assert told[1] == f"done: {there}"
    assert told[3] == f"already done: {there}"
    assert (there.read_bytes(), there.stat().st_mode & 0o777) == (b"new", 0o640)


def test_what_fails_leaves_all_as_it_was(tmp_path: Path) -> None:
    changed, made = tmp_path / "changed", tmp_path / "folder/made"
    changed.write_bytes(b"before")
    steps = [
        file_written(changed, b"after"),
        file_written(made, b"new"),
        Step("something that fails", lambda: False, lambda: command("false")),
        file_written(tmp_path / "never", b""),
    ]
    with pytest.raises(InstallError) as refused:
        carry_out(steps, lambda text: None, dry_run=False)
    assert str(refused.value) == (
        "something that fails: `false` ended with status 1: said nothing; nothing is left of it"
    )
    assert changed.read_bytes() == b"before"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["changed"]


def test_what_cannot_be_undone_is_named(tmp_path: Path) -> None:
    def cannot() -> None:
        raise OSError("no")

    steps = [
        Step("a", lambda: False, lambda: None, cannot),
        Step("b", lambda: False, lambda: command("no-such-command")),
    ]
    with pytest.raises(InstallError, match=r"not on this computer; not undone: a$"):
        carry_out(steps, lambda text: None, dry_run=False)


def test_files_and_folders_are_removed_once(tmp_path: Path) -> None:
    (tmp_path / "folder/in").mkdir(parents=True)
    (tmp_path / "link").symlink_to("nowhere")
    steps = [removed(tmp_path / name) for name in ("folder", "link", "never")]
    carry_out(steps, lambda text: None, dry_run=False)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("user", [False, True])
def test_unit_runs_the_program_where_it_is(user: bool) -> None:
    unit = unit_for(Path("/srv/own/bin/companion"), user)
    config = "%h/.config/companion/companion.toml" if user else "/etc/companion/companion.toml"
    assert f"ExecStart=/srv/own/bin/companion run --config {config}\n" in unit
    assert "/opt/companion/bin/companion run" not in unit
    if user:
        home = {"HOME": "/home/pilot"}
        assert str(user_places(home).config) == config.replace("%h", "/home/pilot")


def test_all_that_is_set_up_comes_with_the_program() -> None:
    for name in ("companion.service", "companion-user.service", "99-companion.rules"):
        assert shipped(name)
    with pytest.raises(InstallError, match="install it anew"):
        shipped("nothing")


def test_an_environment_that_a_service_cannot_read_is_known(tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    assert "is not there" in why_unfit(tmp_path)
    program = tmp_path / "bin/companion"
    program.parent.mkdir(mode=0o700)
    program.write_text("")
    assert why_unfit(tmp_path)  # the folder, or this very test's Python


def test_a_bad_configuration_is_refused_before_anything_is_done(tmp_path: Path) -> None:
    bad = tmp_path / "bad.toml"
    bad.write_text("[camera]\ndevise = 'auto'\n")
    told: list[str] = []
    with pytest.raises(InputError, match="device"):
        install(bad, told.append, user=False, venv=None, now=True, dry_run=True)
    assert not told


@pytest.mark.skipif(os.geteuid() != 0, reason="as another user it is refused for that")
def test_dry_run_says_each_step_and_does_none() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "companion", "install", "--dry-run", "--now"],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    said = done.stdout
    for step in ("user companion", "companion.toml", "companion.service", "service enabled"):
        assert any(step in line for line in said.splitlines()), said
    assert "done:" not in said
