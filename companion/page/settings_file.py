"""The file of settings, changed key by key with its comments kept, and what was changed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomlkit

from companion.config.passwords import without_passwords
from companion.config.setting_keys import dump, value_of_key
from companion.config_file import config_of_text, load_config, toml_value, values_in, values_of
from companion.errors import ConfigError
from companion.products.atomic_file import write_atomically
from drivers.images.calibration_file import own_calibration

CHANGES = ".page-changes.json"
MOST_CHANGES = 50


@dataclass(frozen=True, slots=True)
class Change:
    """One key that was changed: TOML of its value before and after, None where it was not there."""

    number: int
    name: str
    before: str | None
    after: str | None


def value_of_text(name: str, text: str) -> Any:
    """Value that a text of a form gives a key, checked as `--set`; ConfigError."""
    return value_of_key(load_config(None, [f"{name}={text}"], lambda _: None), name)


class SettingsFile:
    """Writes a file of settings; `path` is None where the daemon was started without one.

    `flights` is the folder that keeps the list of changes.
    """

    def __init__(self, path: Path | None, flights: Path) -> None:
        self.path = path
        self._changes = flights / CHANGES

    def set(self, wanted: Mapping[str, Any]) -> list[Change]:
        """Set keys, all or none; None takes a key out of the file.

        ConfigError with what is wrong, FlightError with what is of the calibration that is named.

        The file stays as it was unless all of it is valid with the new values.
        """
        if self.path is None:
            raise ConfigError("companion was started without --config FILE: nothing can be kept")
        path = self.path
        before = values_in(path) if path.exists() else {}
        known = dump(load_config(None))
        for name in wanted:
            if name not in known:
                raise ConfigError(f"{name}: no such key")
        text = _with(path.read_text("utf-8") if path.exists() else "", wanted)
        after = {name: value for name, value in {**before, **wanted}.items() if value is not None}
        if {k: _plain(v) for k, v in values_of(text, str(path)).items()} != {
            k: _plain(v) for k, v in after.items()
        }:
            raise ConfigError(f"{path}: is written too unusually to be changed from the page")
        self._check(text)
        calibration = wanted.get("camera.calibration")
        if calibration:  # with a wrong one no daemon starts, nor the page that could mend it
            own_calibration(Path(calibration))
        try:
            write_atomically(path, text.encode(), durable=True, like=path if before else None)
        except OSError as error:
            raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error
        return self._note(before, after, wanted)

    def undo(self, number: int) -> list[Change]:
        """Put a key back to what it was before a change; ConfigError."""
        found = next((each for each in self.changes() if each.number == number), None)
        if found is None:
            raise ConfigError("this change is not known any more")
        value = None
        if found.before is not None:
            value = tomlkit.parse(f"value = {found.before}").unwrap()["value"]
        return self.set({found.name: value})

    def changes(self) -> list[Change]:
        """Changes made by the page, the newest last."""
        try:
            told = json.loads(self._changes.read_bytes())
            return [Change(**each) for each in told]
        except (OSError, ValueError, TypeError):
            return []  # none yet; a damaged list is begun anew

    def _check(self, text: str) -> None:
        """Refuse text that `companion check-config` would refuse."""
        config_of_text(text, str(self.path), lambda _: None)

    def _note(
        self, before: Mapping[str, Any], after: Mapping[str, Any], wanted: Mapping[str, Any]
    ) -> list[Change]:
        earlier = self.changes()
        number = earlier[-1].number + 1 if earlier else 1
        new = [
            Change(number + n, name, _toml(before.get(name)), _toml(after.get(name)))
            for n, name in enumerate(wanted)
            if before.get(name) != after.get(name)
        ]
        kept = [
            {"number": c.number, "name": c.name, "before": c.before, "after": c.after}
            for c in [*earlier, *new][-MOST_CHANGES:]
        ]
        try:
            # a URL may hold a password
            write_atomically(self._changes, json.dumps(kept).encode(), mode=0o600)
        except OSError as error:
            raise ConfigError(
                f"set, but the list of changes cannot be kept: {error.strerror}"
            ) from error
        return new


def shown_value(value: Any) -> str:
    """A value as the form shows it: text without quotes, lists and numbers as TOML."""
    return without_passwords(value) if isinstance(value, str) else toml_value(value)


def _with(text: str, wanted: Mapping[str, Any]) -> str:
    document = tomlkit.parse(text)
    for name, value in wanted.items():
        *tables, key = name.split(".")
        here: Any = document
        for depth, table in enumerate(tables):
            if table not in here:
                if value is None:
                    break
                here[table] = tomlkit.table(is_super_table=depth + 1 < len(tables))
            here = here[table]
        else:
            if value is None:
                here.pop(key, None)
            else:
                here[key] = _plain(value)
    return tomlkit.dumps(document)


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _toml(value: Any) -> str | None:
    return None if value is None else toml_value(value)
