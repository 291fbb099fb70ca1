"""Passwords in settings and command lines, made unreadable."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from companion.config import Config
from companion.config.setting_keys import dump, with_values

HIDDEN = "***"
"""Text in place of a password."""
_PASSWORD = re.compile(r"(://[^:/@\s]*):[^/\s]+@")
_PASSWORD_MISTYPED = re.compile(r"""\b(\w+:/?[^:/@\s"',]+):[^:/@\s"',]+@""")
"""With a slash or both left out, as in a configuration that does not work yet."""
_PASSWORD_GIVEN = re.compile(
    r"""\b(user-pw|proxy-pw|password|passwd|pwd|pass|passphrase|\w*token|\w*secret)="""
    r"""("[^"]*"|'[^']*'|[^\s&"'!]+)""",
    re.IGNORECASE,
)
"""In a pipeline of GStreamer, and in the query of a URL."""


def with_passwords_hidden(config: Config) -> Config:
    """The configuration with the passwords of URLs and pipelines made unreadable.

    Before it is text: in TOML and JSON a quote within a value is another one.
    """
    return with_values(config, {name: _hidden(value) for name, value in dump(config).items()})


def _hidden(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(map(_hidden, value))
    return without_passwords(value) if isinstance(value, str) else value


def without_passwords(text: str) -> str:
    """A text, with the passwords of URLs and pipelines in it made unreadable."""
    for url in (_PASSWORD, _PASSWORD_MISTYPED):
        text = url.sub(rf"\1:{HIDDEN}@", text)
    return _PASSWORD_GIVEN.sub(rf"\1={HIDDEN}", text)


def command_shown(argv: Sequence[str]) -> str:
    """A command line as a report has it: without passwords, and without where the program lies."""
    return without_passwords(shlex.join([Path(argv[0]).name, *argv[1:]]))
