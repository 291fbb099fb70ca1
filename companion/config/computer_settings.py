"""The computer that the program runs on."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from typing import Literal

NO_PROFILE = "none"


@dataclass(frozen=True, slots=True)
class ComputerConfig:
    """The computer that the program runs on; see docs/budget.md."""

    profile: Literal["none", "pi4", "pi5", "orin-nano", "n100", "desktop"] = "none"
    """Settings that fit it, below those of the file; `--profile` sets this key."""


def profile_text(name: str) -> str:
    """A profile, as the text of a TOML file; its name is one of those that the key may be."""
    return (resources.files("companion.config") / "profiles" / f"{name}.toml").read_text("utf-8")
