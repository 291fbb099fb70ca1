"""Configuration files: TOML and `KEY=VALUE` overrides as a checked `Config`, and back.

A key is named as files have it: `camera.width`, `expert.features.n_features`. What is wrong is a
ConfigError of one line: where, which key, what was wanted, and the nearest key known. Nothing is
guessed and nothing unknown is passed over; a key of the version before is told with its successor.
"""

from __future__ import annotations

import difflib
import json
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

from companion.config import ADDRESS, EXPERT, Config
from companion.config.computer_settings import NO_PROFILE, profile_text
from companion.config.passwords import with_passwords_hidden
from companion.config.setting_keys import (
    dump,
    kind_of,
    listed_words_of,
    number_or_word,
    types_of_keys,
    with_values,
    words_of,
)
from companion.errors import ConfigError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

CONSTANTS: Mapping[str, Any] = {
    "link.timesync_hz": 10.0, "features.fast_threshold": 12, "features.min_fast_threshold": 4,
    "features.max_fast_threshold": 60, "features.cell_px": 32,
    "tracking.min_init_parallax_deg": 1.0, "tracking.keyframe_min_share": 0.75,
    "tracking.keyframe_parallax_deg": 3.0, "tracking.keyframe_max_s": 3.0, "mapping.window": 10,
    "mapping.n_fixed": 10, "mapping.iterations": 6, "mapping.final_iterations": 8,
    "mapping.keyframe_spacing_deg": 1.0, "depth.n_updates": 7, "depth.lag_keyframes": 2,
    "depth.noise_grey": 1.0,
}  # fmt: skip
"""Keys of version 0.1.0 that are no more, with the value that counts instead."""

KINDS = {"float": "a number", "int": "a whole number", "bool": "true or false", "str": "text"}
"""Python's types, as whoever sets a key calls them."""


@cache
def warn_on_stderr(line: str) -> None:
    """Say a line once: a program reads its configuration several times."""
    print(f"companion: {line}", file=sys.stderr, flush=True)


Warn = Callable[[str], None]


def load_config(
    path: Path | None, overrides: Sequence[str] = (), warn: Warn = warn_on_stderr
) -> Config:
    """The defaults, changed by a profile, by a TOML file, then by overrides `KEY=VALUE` in order.

    File or overrides name the profile, if any. An override's value is TOML; text that is not is
    taken as a string, so that quotes may be left out. `warn` takes a line for each key of the
    version before.
    """
    config = _changed(Config(), path, overrides, warn)
    if config.computer.profile != NO_PROFILE:
        config = _changed(of_profile(config.computer.profile), path, overrides, lambda line: None)
    return with_fixed_camera_only(config)


def of_profile(name: str) -> Config:
    """The defaults, changed by a profile."""
    return config_of_text(profile_text(name), f"profile {name}")


def _changed(config: Config, path: Path | None, overrides: Sequence[str], warn: Warn) -> Config:
    if path is not None:
        config = changed_by(config, path, warn)
    for override in overrides:
        name, text = _split(override)
        for current in _current({name: text}, f"--set {override}", warn):
            value = _parse(text, current)
            config = with_value(config, current, value, f"--set {override}")
    return config


def with_fixed_camera_only(config: Config) -> Config:
    """The configuration; ConfigError where it wants of a gimbal what a fixed camera alone gives."""
    if config.mount.type == "fixed":
        return config
    for key, is_set in (
        ("feedback.flow", config.feedback.flow != "off"),
        ("landing.marker", config.landing.marker != "off"),
        ("video.overlay with the horizon", "horizon" in config.video.overlay),
    ):
        if is_set:
            raise ConfigError(
                f"{key} needs a camera that is fixed to the body: mount.type is gimbal"
            )
    return config


def changed_by(config: Config, path: Path, warn: Warn = warn_on_stderr) -> Config:
    """A configuration changed by a TOML file."""
    for name, value in _current(values_in(path), str(path), warn).items():
        config = with_value(config, name, value, str(path))
    return config


def config_of_text(text: str, where: str, warn: Warn = warn_on_stderr) -> Config:
    """A configuration in the words of a TOML file, as recordings have it; `where` it comes from."""
    config = Config()
    for name, value in _current(values_of(text, where), where, warn).items():
        config = with_value(config, name, value, where)
    return config


def values_in(path: Path) -> dict[str, Any]:
    """Value of each key in a TOML file of this version or the one before; neither is checked."""
    try:
        text = path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise ConfigError(f"{path}: cannot read the configuration: {reason}") from error
    return values_of(text, str(path))


def values_of(text: str, where: str) -> dict[str, Any]:
    """The same of the text of a file."""
    try:
        return dict(_flat(tomllib.loads(text), "", where))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{where}: not valid TOML: {error}") from error


def current_key(name: str) -> str:
    """The key that a key of the version before is now; "" for a constant, any other as it is."""
    if name in CONSTANTS:
        return ""
    return f"{EXPERT}.{name}" if f"{EXPERT}.{name}" in types_of_keys() else name


def with_value(config: Config, name: str, value: Any, where: str) -> Config:
    """A configuration with one value changed, checked as one of a file; `where` it comes from."""
    try:
        checked = msgspec.convert(value, types_of_keys()[name])
    except msgspec.ValidationError as error:
        words = ", ".join(words_of(name))
        wanted = f"wanted one of {words}" if words else _wanted_list(name) or _in_words(error)
        if (limits := number_or_word(name)) is not None:
            word, least, most = limits
            wanted = f"wanted {word} or a number from {least:.15g} to {most:.15g}"
        raise ConfigError(f"{where}: {name}: {wanted}, given is {value!r}") from error
    if ADDRESS in getattr(types_of_keys()[name], "__metadata__", ()) and not _is_address(checked):
        raise ConfigError(f'{where}: {name}: wanted HOST:PORT, or "", given is {value!r}')
    if listed_words_of(name) and len(set(checked)) < len(checked):
        raise ConfigError(f"{where}: {name}: {_wanted_list(name)}, given is {value!r}")
    return with_values(config, {name: checked})


def _is_address(text: str) -> bool:
    """True for HOST:PORT, [IPV6]:PORT and nothing; whether the host is there is not asked."""
    host, _, port = text.rpartition(":")
    bare = host.removeprefix("[").removesuffix("]")
    named = bool(bare) and (":" in bare) == (host != bare)
    return not text or (named and port.isascii() and port.isdigit() and int(port) < 65536)


def _in_words(error: msgspec.ValidationError) -> str:
    """The reason why a value is invalid, without the names of Python's types."""
    found = re.match(r"Expected `(\w+)`( [<>]=? \S+)?", str(error))
    if found is None or found[1] not in KINDS:
        return str(error)
    where = " in the list" if "$[" in str(error) else ""
    return f"wanted {KINDS[found[1]]}{found[2] or ''}{where}"


def shown(config: Config) -> dict[str, Any]:
    """The same as tables of tables, with passwords made unreadable."""
    out: dict[str, Any] = {}
    for name, value in dump(with_passwords_hidden(config)).items():
        *tables, key = name.split(".")
        table = out
        for each in tables:
            table = table.setdefault(each, {})
        table[key] = value
    return out


def to_toml(config: Config) -> str:
    """The whole configuration as a TOML file that `load_config` reads back."""
    tables: dict[str, list[str]] = {}
    for name, value in dump(config).items():
        table, _, key = name.rpartition(".")
        tables.setdefault(table, [f"[{table}]"]).append(f"{key} = {toml_value(value)}")
    return "\n\n".join("\n".join(lines) for lines in tables.values()) + "\n"


def toml_value(value: Any) -> str:
    """One value as TOML writes it."""
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value, ensure_ascii=False)


@cache
def _sections() -> frozenset[str]:
    """Every section of this version and the one before."""
    known = {name.rpartition(".")[0] for name in [*types_of_keys(), *CONSTANTS]}
    return frozenset({EXPERT, *known, *(name.removeprefix(f"{EXPERT}.") for name in known)})


def _flat(table: Mapping[str, Any], prefix: str, where: str) -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        name = prefix + key
        if name in _sections():
            if not isinstance(value, dict):
                wanted = f"write [{name}] and its keys below"
                raise ConfigError(f"{where}: {name} is a section: {wanted}")
            yield from _flat(value, f"{name}.", where)
        elif isinstance(value, dict):
            raise _unknown(f"{name}.", where)
        else:
            yield name, value


def _current(values: Mapping[str, Any], where: str, warn: Warn) -> dict[str, Any]:
    """The values by the keys of this version."""
    out = {}
    for name, value in values.items():
        current = current_key(name)
        if not current:
            warn(f"{where}: {name} has no effect any more, {CONSTANTS[name]} counts: take it out")
            continue
        if current not in types_of_keys():
            raise _unknown(name, where)
        if current != name:
            if current in values:
                raise ConfigError(f"{where}: {name} is now {current}, which is set too: remove one")
            warn(f"{where}: {name} is now {current}")
        out[current] = value
    return out


def _split(override: str) -> tuple[str, str]:
    name, equals, text = override.partition("=")
    section, _, key = name.strip().rpartition(".")
    if not (equals and section and key):
        raise ConfigError(f"--set {override}: wanted section.key=value")
    return name.strip(), text.strip()


def _wanted_list(name: str) -> str:
    words = ", ".join(listed_words_of(name))
    return f"wanted a list of {words}, each at most once" if words else ""


def _parse(text: str, name: str) -> Any:
    try:
        table = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        return text
    if set(table) != {"value"}:
        return text
    value = table["value"]
    # A device may be called 3090: what is wanted as text and was not quoted is text.
    is_text = kind_of(name) is str or words_of(name)
    return text if is_text and not isinstance(value, str) else value


def _unknown(name: str, where: str) -> ConfigError:
    section, _, key = name.rpartition(".")
    if section and section not in _sections():
        known = {each.rpartition(".")[0]: None for each in types_of_keys()}
        near = _nearest(f"[{section}]", [f"[{each}]" for each in known])
        return ConfigError(f"{where}: unknown section [{section}]{near}")
    same = section.split(".")[-1]
    here = {each.split(".")[-1]: each for each in types_of_keys() if each.split(".")[-2] == same}
    elsewhere = [each for each in types_of_keys() if each.endswith(f".{key}")]
    close = difflib.get_close_matches(key, here, n=1)
    others = elsewhere or list(types_of_keys())
    near = f"; did you mean {here[close[0]]}?" if close else _nearest(name, others)
    return ConfigError(f"{where}: unknown key {name}{near}")


def _nearest(name: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
    return f"; did you mean {close[0]}?" if close else f"; known are {', '.join(known)}"
