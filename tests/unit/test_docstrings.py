"""Docstrings begin with what the thing is or does."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
FILES = sorted(path for room in ("companion", "drivers") for path in (ROOT / room).rglob("*.py"))
CLAUSE = re.compile(r"(?:How|That|What|When|Where|Whether|Which|Who|Whose|Why)\b")
"""Beginning of a clause about the thing, which does not say what it is."""


def docstrings(source: str) -> Iterator[tuple[int, str]]:
    """Line and text of every docstring, those below attributes and constants too."""
    for node in ast.walk(ast.parse(source)):
        if (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            yield node.lineno, node.value.value.strip()


def clauses_in(source: str) -> list[int]:
    """Lines of docstrings that begin with such a clause."""
    return [line for line, text in docstrings(source) if CLAUSE.match(text)]


def test_docstrings_begin_with_what_the_thing_is_or_does() -> None:
    found = {
        str(path.relative_to(ROOT)): lines
        for path in FILES
        if (lines := clauses_in(path.read_text("utf-8")))
    }
    assert found == {}


def test_clauses_are_found() -> None:
    source = 'class Scan:\n    """File."""\n\n    whole: bool\n    """Whether it has an end."""\n'
    assert clauses_in(source) == [5]
