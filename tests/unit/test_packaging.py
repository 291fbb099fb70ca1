"""The scripts of packaging/: their syntax, and that the tests which one of them names are there."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from companion import __version__
from companion.config_file import load_config

ROOT = Path(__file__).parents[2]
EMULATED = ROOT / "packaging/test_aarch64.sh"
SCRIPTS = sorted(
    [
        *ROOT.glob("packaging/*.sh"),
        *(ROOT / "packaging/deb" / each for each in ("preinst", "postinst", "prerm", "postrm")),
        ROOT / "packaging/deb/companion-back",
        ROOT / "packaging/deb/prune.sh",
    ]
)


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


def test_container_tells_blueos_what_it_needs() -> None:
    """Labels as BlueOS reads them: some are JSON, the version is that of the program."""
    text = (ROOT / "packaging/Containerfile").read_text("utf-8").replace("\\\n", "")
    labels = dict(re.findall(r"""(\w+)='([^']*)'""", text))
    for name in ("tags", "links", "authors", "company", "permissions"):
        json.loads(labels[name])
    permissions = json.loads(labels["permissions"])
    assert permissions["HostConfig"]["NetworkMode"] == "host"
    kept = [each.split(":")[1] for each in permissions["HostConfig"]["Binds"]]
    begins = permissions["Entrypoint"][2]
    assert "/var/lib/companion" in kept and "cd /var/lib/companion" in begins
    for setting in re.findall(r"--set (\S+)", begins):
        load_config(None, [setting])
    assert f'LABEL version="{__version__}"' in text


def test_the_package_leaves_out_what_is_never_loaded(tmp_path: Path) -> None:
    gone = [
        "numpy/tests/a.py", "scipy/stats/tests/data/a.npy", "pyarrow/include/arrow/api.h",
        "pyarrow/libarrow_flight.so.2600", "pymavlink/dialects/v20/paparazzi.py",
        "pymavlink/dialects/v20/ardupilotmega.xml",
    ]  # fmt: skip
    kept = [
        "numpy/testing/a.py", "pyarrow/libarrow.so.2600", "pymavlink/dialects/v10/all.py",
        "pymavlink/dialects/v20/ardupilotmega.py", "pymavlink/dialects/v20/__init__.py",
    ]  # fmt: skip
    for name in gone + kept:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    subprocess.run(["sh", ROOT / "packaging/deb/prune.sh", tmp_path], check=True, timeout=60)
    assert {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()} == set(kept)


def test_wheel_has_the_sample_flight() -> None:
    settings = (ROOT / "pyproject.toml").read_text("utf-8")
    for source, place in re.findall(r'^"(sample/[^"]+)" = "(companion/[^"]+)"$', settings, re.M):
        assert (ROOT / source).is_file()
        assert place == f"companion/{source}"
    assert settings.count('= "companion/sample/survey/') == 4


def made_package(folder: Path, version: str) -> Path:
    """A package with the scripts of ours that an update needs, and next to nothing in it."""
    root = folder / version
    program = root / "opt/companion/bin/companion"
    unit = root / "usr/lib/systemd/system/companion.service"
    for path, text in (
        (program, f"#!/bin/sh\necho companion {version}\n"), (unit, f"# {version}\n"),
        (root / "DEBIAN/control", f"Package: companion\nVersion: {version}\n"
         "Architecture: all\nMaintainer: none <none@localhost>\nDescription: a trial\n"),
    ):  # fmt: skip
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    program.chmod(0o755)
    for name in ("preinst", "prerm", "postrm"):
        shutil.copy2(ROOT / "packaging/deb" / name, root / "DEBIAN" / name)
    package = folder / f"companion_{version}.deb"
    subprocess.run(["dpkg-deb", "--build", root, package], check=True, capture_output=True)
    return package


@pytest.mark.skipif(not shutil.which("dpkg"), reason="needs dpkg")
def test_the_version_before_an_update_is_kept_and_comes_back(tmp_path: Path) -> None:
    root, admin = tmp_path / "root", tmp_path / "root/var/lib/dpkg"
    for folder in ("info", "updates", "triggers"):
        (admin / folder).mkdir(parents=True)
    (admin / "status").touch()
    yours = root / "var/lib/companion/flights/site.map"
    yours.parent.mkdir(parents=True)
    yours.write_text("a map")

    tools = tmp_path / "tools"
    tools.mkdir()
    path = f"{tools}:{os.environ['PATH']}"

    def run(*command: str | Path) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            command, capture_output=True, text=True, timeout=60, check=False,
            env={**os.environ, "DPKG_ROOT": str(root), "PROOF_S": "1", "PATH": path},
        )  # fmt: skip

    def service(ready: bool) -> None:
        """The only thing that is asked of systemd here."""
        (tools / "systemctl").write_text(f"#!/bin/sh\nexit {0 if ready else 3}\n")
        (tools / "systemctl").chmod(0o755)

    def installed(version: str) -> None:
        forces = "--force-not-root,script-chrootless,depends,bad-path"
        done = run("dpkg", forces, f"--root={root}", "--install", made_package(tmp_path, version))
        assert done.returncode == 0, done.stderr

    def is_there() -> tuple[str, str]:
        said = run(root / "opt/companion/bin/companion").stdout.strip()
        return said, (root / "usr/lib/systemd/system/companion.service").read_text().strip()

    back = ROOT / "packaging/deb/companion-back"
    installed("1.0")
    assert "no version from before an update" in run(back).stderr
    installed("1.1")
    assert is_there() == ("companion 1.1", "# 1.1")
    for version in ("1.0", "1.1", "1.0"):
        assert run(back).stdout == f"companion-back: companion {version} is in place\n"
        assert is_there() == (f"companion {version}", f"# {version}")
    installed("1.2")  # over the one that came back
    assert is_there() == ("companion 1.2", "# 1.2")
    service(ready=True)
    assert run(back, "--unless-ready").stdout.endswith("companion 1.2 is ready and stays\n")
    assert is_there() == ("companion 1.2", "# 1.2")
    service(ready=False)
    assert "not ready within 1 s" in run(back, "--unless-ready").stderr
    assert is_there() == ("companion 1.0", "# 1.0")
    assert yours.read_text() == "a map"


@pytest.mark.parametrize("made_by", ["packaging/build_deb.sh", "packaging/Containerfile"])
def test_loops_are_compiled_where_they_are_installed(made_by: str) -> None:
    """And not those of the clone, which it is made from: -I leaves out the folder one is in."""
    text = (ROOT / made_by).read_text("utf-8")
    (line,) = re.findall(r".*-m companion\.slam\.compiled\.ship", text)
    assert line.endswith("-I -m companion.slam.compiled.ship")
