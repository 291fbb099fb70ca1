"""Texts, bounds and units of settings, read from companion/config."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from msgspec import Meta

from companion.config import EXPERT, Config
from companion.config_file import toml_value

PURPOSES = {
    "Computer": ("computer",),
    "Camera": ("camera", "mount"),
    "Autopilot": ("link", "router", "telemetry", "feedback", "landing", "gps", "control"),
    "Flights, and what is kept of them": ("daemon", "recorder", "map"),
    "Dense map": ("depth", "cloud", "opencl"),
    "Looking on, other machines": ("page", "stream", "video", "distributed"),
}
"""Sections with public keys."""


@dataclass(frozen=True, slots=True)
class Setting:
    """One key, and its text."""

    name: str
    default: str
    values: str
    text: str


@cache
def settings(section: str, expert: bool) -> tuple[Setting, ...]:
    """Those of a section, in the order of its class."""
    return tuple(_settings(section, expert))


def _settings(section: str, expert: bool) -> Iterator[Setting]:
    kind = get_type_hints(Config)[section]
    texts = _texts(kind)
    for key, hint in get_type_hints(kind, include_extras=True).items():
        marks = getattr(hint, "__metadata__", ())
        if (EXPERT in marks) == expert:
            name = f"{EXPERT}.{section}.{key}" if expert else f"{section}.{key}"
            default = toml_value(getattr(getattr(Config(), section), key))
            yield Setting(name, default, _values(hint, marks), texts.get(key, ""))


def _texts(kind: type) -> dict[str, str]:
    """The text below each key; Python itself forgets it."""
    (class_,) = ast.parse(inspect.getsource(kind)).body
    assert isinstance(class_, ast.ClassDef)
    return {
        above.target.id: " ".join(str(below.value.value).split())
        for above, below in zip(class_.body, class_.body[1:], strict=False)
        if isinstance(above, ast.AnnAssign)
        and isinstance(above.target, ast.Name)
        and isinstance(below, ast.Expr)
        and isinstance(below.value, ast.Constant)
    }


def _values(hint: Any, marks: tuple[Any, ...]) -> str:
    kind = get_args(hint)[0] if get_origin(hint) is Annotated else hint
    of_each = get_args(kind)[0] if get_origin(kind) is tuple else kind
    if get_origin(of_each) is Literal:
        return ", ".join(get_args(of_each))
    if get_origin(kind) is Union:
        return ", ".join(
            _values(each, getattr(each, "__metadata__", ())) for each in get_args(kind)
        )
    limits = next((mark for mark in marks if isinstance(mark, Meta)), None)
    return "" if limits is None else f"{limits.ge:.15g} to {limits.le:.15g}"
