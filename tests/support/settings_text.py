"""config/companion.toml and docs/settings.md, made of companion/config.

`make settings` writes them, and docs/commands.md.
"""

from __future__ import annotations

import inspect
import textwrap
from pathlib import Path
from typing import get_type_hints

from companion.config import Config
from companion.page.setting_texts import PURPOSES, Setting, settings
from tests.support.commands_text import commands_page

ROOT = Path(__file__).parents[2]
TOML_HEAD = """\
# Settings, with their defaults. Take the "#" away before a key to change it; a file needs only what
# it changes. The same keys go on the command line: --set depth.enabled=false. Keys that few drones
# need, below [expert], are in docs/settings.md.
"""
PAGE_HEAD = """\
# Settings

A TOML file (`companion run --config FILE`) changes the keys that it names; `--set KEY=VALUE` goes
over it. `config/companion.toml` is one to start from. An unknown key, a wrong type or a value out
of range is refused, with the nearest key that exists. `--profile NAME` puts settings that fit a
computer below those of the file: [computers and their profiles](budget.md).

    companion check-config --config FILE              # the whole of what would be used
    companion check-config --config FILE --migrate    # writes a file of the version before anew

A file of the version before works as well: for each key that is called otherwise now, or is no
more, a line says so. `--migrate` renames and removes them; the file as it was stays beside it, as
`.bak`.
"""
EXPERT_HEAD = """
## Expert

Few drones need these: their defaults were found by tests, or fit nearly all. In a file
`[expert.camera]` is the section of `expert.camera.gain`. All other numbers are constants beside the
code that uses them.
"""
TABLE_HEAD = "\n| key | default | values | |\n|---|---|---|---|"


def described_toml() -> str:
    """The public keys, each commented out below its text."""
    blocks = [TOML_HEAD]
    for section in (each for sections in PURPOSES.values() for each in sections):
        lines = [_comment(inspect.getdoc(get_type_hints(Config)[section]) or ""), f"[{section}]"]
        for it in settings(section, expert=False):
            values = f" ({it.values})" if it.values else ""
            lines += [_comment(it.text[:-1] + values + it.text[-1:])]
            lines += [f"#{it.name.split('.')[-1]} = {it.default}"]
        blocks.append("\n".join(lines) + "\n")
    return "\n".join(blocks)


def settings_page() -> str:
    """All keys in tables, the public ones by purpose."""
    lines = [PAGE_HEAD]
    for purpose, sections in PURPOSES.items():
        lines += [f"## {purpose}"]
        for section in sections:
            lines += ["", inspect.getdoc(get_type_hints(Config)[section]) or "", TABLE_HEAD]
            lines += [_row(each) for each in settings(section, expert=False)]
        lines += [""]
    lines += [EXPERT_HEAD[1:] + TABLE_HEAD]
    lines += [_row(each) for section in get_type_hints(Config) for each in settings(section, True)]
    return "\n".join(lines) + "\n"


def _row(it: Setting) -> str:
    return f"| `{it.name}` | `{it.default}` | {it.values} | {it.text} |"


def _comment(text: str) -> str:
    parts = [textwrap.wrap(" ".join(part.split()), 98) for part in text.split("\n\n")]
    return "\n".join(f"# {line}" for part in parts for line in part)


def main() -> None:
    """Write them."""
    (ROOT / "config/companion.toml").write_text(described_toml(), "utf-8")
    (ROOT / "docs/settings.md").write_text(settings_page(), "utf-8")
    (ROOT / "docs/commands.md").write_text(commands_page(), "utf-8")


if __name__ == "__main__":
    main()
