"""Settings from the ground: differences from the configuration, and the file that keeps them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from companion.config import Config
from companion.config.setting_keys import dump
from companion.config_file import changed_by, toml_value, with_value
from companion.daemon.control.flight_parameters import PARAMETERS, FlightParameter
from companion.errors import ConfigError

HEAD = "# What the ground has set over MAVLink; expert.control.keep names this file.\n"
KEYS = {parameter.full_key for parameter in PARAMETERS.values()}


def kept_over(load: Callable[[], Config]) -> tuple[Config, dict[str, Any]]:
    """The configuration with kept settings applied, and these by key.

    ConfigError where the file cannot be read, or names keys that no ground station can set.
    """
    config = load()
    if not config.control.keep or not Path(config.control.keep).exists():
        return config, {}
    kept = changed_by(config, Path(config.control.keep))
    changed = differences(config, kept)
    for name in changed:
        if name not in KEYS:
            raise ConfigError(f"{config.control.keep}: {name} is nothing that the ground sets")
    return kept, changed


def differences(config: Config, other: Config) -> dict[str, Any]:
    """Values of the other for each key in which they differ."""
    before = dump(config)
    return {name: value for name, value in dump(other).items() if value != before[name]}


def encoded(changed: Mapping[str, Any]) -> bytes:
    """Content of the file."""
    lines = [f"{name} = {toml_value(value)}" for name, value in sorted(changed.items())]
    return (HEAD + "\n".join(lines) + "\n").encode()


def checked(config: Config, parameter: FlightParameter, value: Any) -> Config:
    """The configuration with a value from the ground, validated as one of a file."""
    return with_value(config, parameter.full_key, value, parameter.name)
