"""Configuration files: TOML and `section.key=value` overrides as a checked `Config`, and back.

What is wrong is a ConfigError of one line: where, which key, what was wanted, and the nearest key
known. Nothing is guessed and nothing unknown is passed over.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from companion.config import Config, OneOf, Range
from companion.errors import ConfigError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_KINDS = {
    bool: "true or false", int: "a whole number", float: "a number", str: "a string",
    tuple: "a list of strings",
}  # fmt: skip
_PASSWORD = re.compile(r"(://[^:/@\s]*):[^@/\s]+@")


@dataclasses.dataclass(frozen=True, slots=True)
class _Key:
    kind: type
    limits: tuple[Range | OneOf, ...]


def load_config(path: Path | None, overrides: Sequence[str] = ()) -> Config:
    """The defaults, changed by a TOML file if any, then by overrides `section.key=value` in order.

    An override's value is TOML; text that is not is taken as a string, so that quotes may be left
    out.
    """
    changed: dict[str, dict[str, Any]] = {section: {} for section in _sections()}
    if path is not None:
        for name, value in _read(path).items():
            _take(changed, name, value, str(path))
    for override in overrides:
        section, key, text = _split(override)
        where = f"--set {override}"
        wanted = _key(section, key, where)
        changed[section][key] = _checked(section, key, _parse(text, wanted.kind), where)
    return _changed(Config(), changed)


def changed_by(config: Config, path: Path) -> Config:
    """A configuration changed by a TOML file."""
    changed: dict[str, dict[str, Any]] = {section: {} for section in _sections()}
    for name, value in _read(path).items():
        _take(changed, name, value, str(path))
    return _changed(config, changed)


def config_of_text(text: str, where: str) -> Config:
    """A configuration in the words of a TOML file, as recordings have it; `where` it comes from."""
    changed: dict[str, dict[str, Any]] = {section: {} for section in _sections()}
    for name, value in _parsed(text, where).items():
        _take(changed, name, value, where)
    return _changed(Config(), changed)


def with_value(config: Config, section: str, key: str, value: Any, where: str) -> Config:
    """A configuration with one value changed, checked as one of a file; `where` it comes from."""
    return _changed(config, {section: {key: _checked(section, key, value, where)}})


def words_of(section: str, key: str) -> tuple[str, ...]:
    """The words that a key may be; none where it is not one of a few."""
    limits = _key(section, key, "words_of").limits
    return next((limit.words for limit in limits if isinstance(limit, OneOf)), ())


def dump(config: Config) -> dict[str, dict[str, Any]]:
    """Every section and key with its value."""
    return dataclasses.asdict(config)


def shown(config: Config) -> dict[str, dict[str, Any]]:
    """The same, without the passwords of URLs."""
    return {
        section: {k: without_passwords(v) if isinstance(v, str) else v for k, v in values.items()}
        for section, values in dump(config).items()
    }


def without_passwords(text: str) -> str:
    """A text, with the passwords of URLs in it made unreadable."""
    return _PASSWORD.sub(r"\1:***@", text)


def command_shown(argv: Sequence[str]) -> str:
    """A command line as a report has it: without passwords, and without where the program lies."""
    return without_passwords(shlex.join([Path(argv[0]).name, *argv[1:]]))


def to_toml(config: Config) -> str:
    """The whole configuration as a TOML file that `load_config` reads back."""
    blocks = []
    for section, values in dump(config).items():
        lines = [f"{key} = {toml_value(value)}" for key, value in values.items()]
        blocks.append("\n".join([f"[{section}]", *lines]) + "\n")
    return "\n".join(blocks)


def toml_value(value: Any) -> str:
    """One value as TOML writes it."""
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value, ensure_ascii=False)


def _changed(config: Config, changed: Mapping[str, Mapping[str, Any]]) -> Config:
    return dataclasses.replace(
        config,
        **{
            section: dataclasses.replace(getattr(config, section), **values)
            for section, values in changed.items()
        },
    )


@cache
def _sections() -> Mapping[str, Mapping[str, _Key]]:
    sections: dict[str, dict[str, _Key]] = {}
    for name, section in get_type_hints(Config).items():
        sections[name] = {}
        for key, hint in get_type_hints(section, include_extras=True).items():
            kind, *limits = get_args(hint) if get_origin(hint) is Annotated else (hint,)
            sections[name][key] = _Key(get_origin(kind) or kind, tuple(limits))
    return sections


def _read(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise ConfigError(f"{path}: cannot read the configuration: {reason}") from error
    return _parsed(text, str(path))


def _parsed(text: str, where: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{where}: not valid TOML: {error}") from error


def _take(changed: dict[str, dict[str, Any]], section: str, values: Any, where: str) -> None:
    if section not in _sections():
        raise ConfigError(f"{where}: unknown section [{section}]{_nearest_section(section)}")
    if not isinstance(values, dict):
        raise ConfigError(f"{where}: {section} is a section: write [{section}] and its keys below")
    for key, value in values.items():
        changed[section][key] = _checked(section, key, value, where)


def _split(override: str) -> tuple[str, str, str]:
    name, equals, text = override.partition("=")
    section, dot, key = name.strip().partition(".")
    if not (equals and dot and section and key):
        raise ConfigError(f"--set {override}: wanted section.key=value")
    return section, key, text.strip()


def _parse(text: str, kind: type) -> Any:
    try:
        table = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        return text
    if set(table) != {"value"}:
        return text
    value = table["value"]
    # A device may be called 3090: what is wanted as text and was not quoted is text.
    return text if kind is str and not isinstance(value, str) else value


def _key(section: str, key: str, where: str) -> _Key:
    if section not in _sections():
        raise ConfigError(f"{where}: unknown section [{section}]{_nearest_section(section)}")
    if key not in _sections()[section]:
        raise ConfigError(f"{where}: unknown key {section}.{key}{_nearest_key(section, key)}")
    return _sections()[section][key]


def _checked(section: str, key: str, value: Any, where: str) -> Any:
    wanted = _key(section, key, where)
    if wanted.kind is float and type(value) is int:
        value = float(value)
    if wanted.kind is tuple and type(value) is list and all(type(v) is str for v in value):
        value = tuple(value)
    if type(value) is not wanted.kind:
        given = _KINDS.get(type(value), f"a {type(value).__name__}")
        raise ConfigError(
            f"{where}: {section}.{key} wants {_KINDS[wanted.kind]}, given is {given}: {value!r}"
        )
    if isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{where}: {section}.{key} wants a finite number, given is {value}")
    allowed: Any = value
    for limit in wanted.limits:
        if not limit.allows(allowed):
            raise ConfigError(f"{where}: {section}.{key} wants {limit}, given is {value!r}")
    return allowed


def _nearest_section(section: str) -> str:
    return _nearest(section, [f"[{name}]" for name in _sections()])


def _nearest_key(section: str, key: str) -> str:
    here = difflib.get_close_matches(key, _sections()[section], n=1)
    if here:
        return f"; did you mean {section}.{here[0]}?"
    elsewhere = [
        f"{other}.{known}" for other, keys in _sections().items() for known in keys if known == key
    ]
    return _nearest(f"{section}.{key}", elsewhere or _all_keys())


def _all_keys() -> list[str]:
    return [f"{section}.{key}" for section, keys in _sections().items() for key in keys]


def _nearest(name: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
    return f"; did you mean {close[0]}?" if close else f"; known are {', '.join(known)}"
