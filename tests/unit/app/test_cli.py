from __future__ import annotations

import errno
import io
import os
import re
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from companion import __version__
from companion.app.cli import READER_GONE, hardware, main
from companion.app.cli.options import held_folder
from companion.config import Config
from companion.config_file import load_config
from companion.errors import InputError
from companion.products.export.exports import PRODUCTS
from tests.support.processes import program
from tests.support.processes.closed_pipe import into_closed_pipe
from tests.support.processes.program import Run

SAMPLE = Path(__file__).parents[3] / "sample" / "survey"


def companion(*arguments: str | Path) -> Run:
    """A command in this process: one of its own takes more than a second to load what it needs."""
    stdout, stderr = io.StringIO(), io.StringIO()
    with redirect_stdout(stdout), redirect_stderr(stderr):
        try:
            status = main([*map(str, arguments)])
        except SystemExit as ended:  # argparse
            status = int(ended.code or 0)
    return Run(status, stdout.getvalue(), stderr.getvalue(), Path())


def refused(run: Run) -> str:
    """The line that says why, after making sure that it is the only one."""
    assert run.stdout == ""
    return program.refused(run)


def test_version() -> None:
    result = companion("--version")
    assert (result.status, result.stdout) == (0, f"companion {__version__}\n")


def test_check_config_prints_what_it_read(tmp_path: Path) -> None:
    given = tmp_path / "given.toml"
    given.write_text("[expert.depth]\nstride = 7\n")
    result = companion("check-config", "--config", given, "--set", "opencl.device=gpu")
    assert (result.status, result.stderr) == (0, "")
    printed = tmp_path / "printed.toml"
    printed.write_text(result.stdout)
    assert load_config(printed) == load_config(given, ["opencl.device=gpu"]) != Config()


def test_check_config_looks_beyond_the_words(tmp_path: Path) -> None:
    line = refused(companion("check-config", "--set", "link.url=rubbish"))
    assert 'link.url: "rubbish" must begin with one of serial:' in line
    result = companion("check-config", "--set", f"camera.calibration={tmp_path / 'none.toml'}")
    assert result.status == 0  # it may be on the drone
    assert result.stderr.startswith("companion: warning: camera.calibration: ")
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("width = 640\nheight = 480\n")
    line = refused(companion("check-config", "--set", f"camera.calibration={wrong}"))
    assert line.endswith("wrong.toml: the key fx is missing")


def test_help_of_export_names_every_format() -> None:
    told = re.sub(r"\s+", "", companion("export", "--help").stdout)
    assert ",".join(PRODUCTS) in told


def test_unknown_key_is_one_line() -> None:
    line = refused(companion("check-config", "--set", "features.nfeatures=3"))
    assert "expert.features.n_features" in line


def test_configuration_that_is_not_there() -> None:
    assert "none.toml" in refused(companion("check-config", "--config", "none.toml"))


def test_an_old_configuration_is_written_anew(tmp_path: Path) -> None:
    given = tmp_path / "given.toml"
    given.write_text("[features]\nn_features = 700\n")
    line = f"companion: {given}: features.n_features is now expert.features.n_features\n"
    assert companion("check-config", "--config", given).stderr == line
    assert companion("check-config", "--config", given, "--migrate").status == 0
    result = companion("check-config", "--config", given)
    assert (result.stderr, "n_features = 700" in result.stdout) == ("", True)
    assert "--config" in refused(companion("check-config", "--migrate"))


def test_flight_that_is_not_there(tmp_path: Path) -> None:
    line = refused(companion("replay", tmp_path / "no-flight", "--out", tmp_path / "out"))
    assert "no-flight" in line
    assert not (tmp_path / "out").exists()


def test_out_that_is_a_file(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.write_text("")
    assert str(out) in refused(companion("replay", tmp_path, "--out", out))


@pytest.mark.parametrize(
    "command",
    [("replay", SAMPLE), ("depth", SAMPLE), ("compare", SAMPLE, SAMPLE)],
)
def test_out_that_cannot_be_written(command: tuple[str | Path, ...]) -> None:
    line = refused(companion(*command, "--out", "/proc/nowhere"))
    assert "/proc/nowhere: cannot be written: " in line and "--out" in line


@pytest.mark.parametrize(
    "command",
    [("map", "prune"), ("map", "save"), ("map", "merge", "a.map"), ("flights", "mission")],
)
def test_out_of_a_file_that_cannot_be_written(tmp_path: Path, command: tuple[str, ...]) -> None:
    out = Path("/proc/nowhere/new.plan")
    line = refused(companion(*command, "none.map", "--out", out))
    assert "/proc/nowhere: cannot be written: " in line and "--out wants a file" in line
    assert f"{tmp_path}: is a folder" in refused(companion(*command, "none.map", "--out", tmp_path))


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ([], "COMMAND"),
        (["fly"], "fly"),
        (["replay", "flight"], "--out"),
        (["replay", "flight", "--out", "out", "--start", "-1"], "--start"),
        (["replay", "flight", "--out", "out", "--stop", "nan"], "--stop"),
        (["replay", "flight", "--out", "out", "--start", "soon"], "--start"),
        (["replay", "flight", "--out", "out", "--viewer", "http://x"], "--viewer"),
        (["replay", "flight", "--out", "out", "--start", "5", "--stop", "5"], "--stop"),
        (["replay", "flight", "--out", "out", "--as-flown", "--paced"], "leave out --paced"),
        (["compare", "a", "b", "--max-apart", "nan"], "--max-apart"),
        (["batch", "flight", "--out", "out", "--workers", "0"], "--workers"),
    ],
)
def test_usage(arguments: list[str], named: str) -> None:
    result = companion(*arguments)
    assert result.status == 2
    assert named in result.stderr.splitlines()[-1]
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize(
    "arguments",
    [["--help"], ["check-config"], ["devices"], ["flights", "list", "--flights", "."]],
)
def test_output_that_nobody_reads_is_no_error(arguments: list[str]) -> None:
    assert into_closed_pipe(*arguments) == (READER_GONE, "")
    assert READER_GONE == 141


@pytest.mark.parametrize("command", ["check-config", "flights list --flights ."])
def test_a_full_disk_is_told_in_one_line(command: str) -> None:
    program = [sys.executable, "-m", "companion", *command.split()]
    with open("/dev/full", "w") as full:
        ended = subprocess.run(
            program, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60, check=False
        )
    assert ended.returncode == 1
    why = "its output cannot be written: No space left on device"
    assert ended.stderr == f"companion: error: {why}\n"


def test_a_file_that_the_disk_does_not_take_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "out/cloud.ply")

    monkeypatch.setattr(hardware, "_devices", full)
    assert main(["devices"]) == 1
    why = "out/cloud.ply cannot be written: No space left on device"
    assert capsys.readouterr().err == f"companion: error: {why}\n"


def test_two_runs_do_not_write_into_one_folder(tmp_path: Path) -> None:
    with held_folder(tmp_path / "out"):
        line = refused(companion("replay", SAMPLE, "--out", tmp_path / "out", "--stop", "0.2"))
        with pytest.raises(InputError), held_folder(tmp_path / "out"):
            pass
    assert "another run writes into it" in line
    with held_folder(tmp_path / "out"):
        pass  # it ends with the run


def test_errors_that_nobody_reads_end_it_too() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "companion", "replay", "none", "--out", "none"]
    ended = subprocess.run(command, stdout=writer, stderr=writer, timeout=60, check=False)
    os.close(writer)
    assert ended.returncode == READER_GONE
