"""Keys of a configuration, named as files have them: what each may be, and its value."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from companion.config import EXPERT, Config


@cache
def types_of_keys() -> Mapping[str, Any]:
    """Type of each key, with its bounds; keys of experts come last."""
    found: dict[str, Any] = {}
    of_experts: dict[str, Any] = {}
    for section, of_section in get_type_hints(Config).items():
        for key, hint in get_type_hints(of_section, include_extras=True).items():
            if EXPERT in getattr(hint, "__metadata__", ()):
                of_experts[f"{EXPERT}.{section}.{key}"] = hint
            else:
                found[f"{section}.{key}"] = hint
    return found | of_experts


def dump(config: Config) -> dict[str, Any]:
    """Every key with its value."""
    return {name: value_of_key(config, name) for name in types_of_keys()}


def with_values(config: Config, values: Mapping[str, Any]) -> Config:
    """The configuration with other values for some keys, not validated."""
    for name, value in values.items():
        section, key = name.split(".")[-2:]
        part = dataclasses.replace(getattr(config, section), **{key: value})
        config = dataclasses.replace(config, **{section: part})
    return config


def value_of_key(config: Config, name: str) -> Any:
    """Value of a key."""
    section, key = name.split(".")[-2:]
    return getattr(getattr(config, section), key)


def words_of(name: str) -> tuple[str, ...]:
    """The words that a key may be; none where it is not one of a few."""
    kind = kind_of(name)
    return get_args(kind) if get_origin(kind) is Literal else ()


def number_or_word(name: str) -> tuple[str, float, float] | None:
    """The word and the bounds of a key that may be either; None of any other key."""
    kind = kind_of(name)
    if get_origin(kind) is not Union:
        return None
    of_word, of_number = get_args(kind)
    (limits,) = of_number.__metadata__
    return get_args(of_word)[0], limits.ge, limits.le


def listed_words_of(name: str) -> tuple[str, ...]:
    """The words that the list of a key may hold, each once; none where it is no list of words."""
    kind = kind_of(name)
    of_each = get_args(kind)[0] if get_origin(kind) is tuple else None
    return get_args(of_each) if get_origin(of_each) is Literal else ()


def kind_of(name: str) -> Any:
    """Type of a key, without its bounds."""
    hint = types_of_keys()[name]
    return get_args(hint)[0] if get_origin(hint) is Annotated else hint
