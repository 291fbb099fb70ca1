"""Installation steps: reported, skipped where done, undone on failure."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from companion.errors import InstallError

PATIENCE_S = 900.0
"""Timeout of a command: an environment is filled over a slow network."""


def nothing() -> None:
    """Do nothing."""


@dataclass(frozen=True, slots=True)
class Step:
    """`do` raises OSError or InstallError where it cannot; `undo` is only called after `do`."""

    what: str
    is_done: Callable[[], bool]
    do: Callable[[], None]
    undo: Callable[[], None] = nothing


def carry_out(steps: Sequence[Step], notify: Callable[[str], None], dry_run: bool) -> None:
    """Do the steps that are not done yet; on failure undo them and raise InstallError."""
    begun: list[Step] = []
    for step in steps:
        if step.is_done():
            notify(f"already done: {step.what}")
            continue
        if dry_run:
            notify(f"would do: {step.what}")
            continue
        begun.append(step)
        try:
            step.do()
        except BaseException as error:
            left = _undo(begun)
            if not isinstance(error, (OSError, InstallError)):
                raise
            after = f"; not undone: {', '.join(left)}" if left else "; nothing is left of it"
            why = error.strerror if isinstance(error, OSError) and error.strerror else error
            raise InstallError(f"{step.what}: {why}{after}") from None
        notify(f"done: {step.what}")


def _undo(begun: list[Step]) -> list[str]:
    left = []
    for step in reversed(begun):
        try:
            step.undo()
        except (OSError, InstallError):
            left.append(step.what)
    return left


def command(*words: str | Path) -> None:
    """Step that runs a command; InstallError with its last output where it fails."""
    text = " ".join(map(str, words))
    try:
        done = subprocess.run(
            [*map(str, words)], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, errors="replace", timeout=PATIENCE_S, check=False,
        )  # fmt: skip
    except FileNotFoundError:
        raise InstallError(f"{words[0]} is not on this computer") from None
    except subprocess.TimeoutExpired:
        raise InstallError(f"`{text}` did not end within {PATIENCE_S:g} s") from None
    if done.returncode:
        said = done.stdout.strip().splitlines() or ["said nothing"]
        raise InstallError(f"`{text}` ended with status {done.returncode}: {said[-1].strip()}")


def file_written(path: Path, content: bytes, mode: int = 0o644) -> Step:
    """Step that writes a file, and makes the folders above it."""
    before: list[bytes] = []
    made: list[Path] = []
    part = path.with_name(f".{path.name}.part")
    replaced = False

    def is_done() -> bool:
        return path.is_file() and path.read_bytes() == content

    def do() -> None:
        nonlocal replaced
        if path.exists():
            before.append(path.read_bytes())
        made.extend(parent for parent in path.parents if not parent.exists())
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(content)
        part.chmod(mode)
        os.replace(part, path)
        replaced = True

    def undo() -> None:
        part.unlink(missing_ok=True)
        if before:
            path.write_bytes(before[0])
        elif replaced:
            path.unlink(missing_ok=True)
        for parent in made:
            if parent.exists():
                parent.rmdir()

    return Step(str(path), is_done, do, undo)


def removed(path: Path) -> Step:
    """Step that removes a file or a folder."""

    def do() -> None:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()

    return Step(f"{path} removed", lambda: not path.exists() and not path.is_symlink(), do)
