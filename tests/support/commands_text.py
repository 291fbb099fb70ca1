"""docs/commands.md, made of companion/app/cli by `make settings`: see settings_text.py."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from companion.app.cli import command_parser
from companion.app.cli.options import configuration

PAGE_HEAD = """\
# Commands

Every command with its arguments and options, as `companion COMMAND --help` has them. The exit
status is 0 when all is done, 1 after a fault, 2 for wrong input or usage, 130 and 143 after Ctrl-C
and SIGTERM. `companion --version` prints the version.

A command that reads a [configuration](settings.md) takes these options besides its own:
"""
READS = "Reads a configuration."
TABLE_HEAD = ["", "| | |", "|---|---|"]


def commands_page() -> str:
    """All commands, each with its own arguments and options in a table."""
    shared = configuration()
    lines = [PAGE_HEAD[:-1], *TABLE_HEAD, *_rows(shared)]
    for name, text, parser in commands_of(command_parser()):
        reads = "--set" in parser._option_string_actions
        rows = _rows(parser, shared if reads else None)
        lines += ["", f"## {name}", "", f"{text} {READS}" if reads else text]
        lines += [*TABLE_HEAD, *rows] if rows else []
    return "\n".join(lines) + "\n"


def commands_of(
    parser: argparse.ArgumentParser, before: str = ""
) -> Iterator[tuple[str, str, argparse.ArgumentParser]]:
    """Name of each command below a parser, what it does, and its own parser."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            short = {each.dest: each.help or "" for each in action._choices_actions}
            for name, of_command in action.choices.items():
                text = of_command.description or _sentence(short[name])
                yield f"{before}{name}", text, of_command
                yield from commands_of(of_command, f"{before}{name} ")


def arguments_of(
    parser: argparse.ArgumentParser, without: argparse.ArgumentParser | None = None
) -> list[argparse.Action]:
    """Arguments and options of a command, without its own commands and the options of another."""
    left_out = set() if without is None else set(without._option_string_actions)
    found = [
        each for each in parser._actions
        if not (left_out | {"--help"}) & set(each.option_strings)
        and not isinstance(each, argparse._SubParsersAction)
    ]  # fmt: skip
    return sorted(found, key=lambda each: bool(each.option_strings))


def _rows(
    parser: argparse.ArgumentParser, without: argparse.ArgumentParser | None = None
) -> list[str]:
    formatter = parser._get_formatter()
    return [
        f"| `{_called(formatter, each)}` | {_help(formatter, each)} |"
        for each in arguments_of(parser, without)
    ]


def _help(formatter: argparse.HelpFormatter, action: argparse.Action) -> str:
    return formatter._expand_help(action).replace("|", " or ") if action.help else ""


def _called(formatter: argparse.HelpFormatter, action: argparse.Action) -> str:
    return formatter._format_action_invocation(action).replace("|", " or ")


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."
