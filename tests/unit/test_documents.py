"""The texts for people: links lead somewhere, what they name is there, the front door is short."""

from __future__ import annotations

import re
import shlex
from functools import cache
from pathlib import Path

import pytest

from companion import __version__
from companion.app.cli import command_parser
from companion.config_file import current_key, load_config
from tests.support.commands_text import arguments_of, commands_of, commands_page

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(
    [*ROOT.glob("*.md"), *(page for room in ("docs", "sample", "systemd", "companion", "drivers")
                           for page in (ROOT / room).rglob("*.md"))]
)  # fmt: skip
NAMED = sorted(
    [*PAGES, ROOT / "Makefile", *ROOT.glob("config/*"),
     *ROOT.glob("systemd/*"), *ROOT.glob("packaging/*.sh"),
     *(each for room in ("companion", "drivers") for kind in ("*.py", "*.cl")
       for each in (ROOT / room).rglob(kind))]
)  # fmt: skip
"""What may name a page or a file."""
MOST_LINES = 150
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
OUTSIDE = ("http://", "https://", "mailto:")
STANDS_FOR = {"N": "1", "A:B": "1:2", "NEAR:FAR": "1:2"}
"""Values for the capitals that a number is given by."""


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


@cache
def prose(page: Path) -> str:
    """Without code, in which brackets are no links."""
    text = re.sub(r"^ *```.*?^ *```$", "", page.read_text("utf-8"), flags=re.M | re.S)
    text = re.sub(r"(?:\A|\n)\n(?:    .*\n|\n)+", "\n\n", text)
    return re.sub(r"`[^`\n]*`", "code", text)


@cache
def anchors(page: Path) -> frozenset[str]:
    """As GitHub makes them of headings, and the site too (mkdocs.yml)."""
    found: set[str] = set()
    fences = re.sub(r"^ *```.*?^ *```$", "", page.read_text("utf-8"), flags=re.M | re.S)
    for heading in re.findall(r"^#+ +(.+?) *$", fences, re.M):
        slug = re.sub(r"[^\w\- ]", "", re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower())
        slug = slug.replace(" ", "-")
        n = 1
        while (numbered := slug if n == 1 else f"{slug}-{n - 1}") in found:
            n += 1
        found.add(numbered)
    return frozenset(found)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page: Path) -> None:
    broken = []
    for target in LINK.findall(prose(page)):
        if target.startswith(OUTSIDE):
            continue
        file, _, anchor = target.partition("#")
        path = (page.parent / file).resolve() if file else page
        if not path.exists() or (anchor and anchor not in anchors(path)):
            broken.append(target)
    assert not broken


@pytest.mark.parametrize("page", [page for page in PAGES if DOCS in page.parents], ids=name_of)
def test_pages_of_the_site_link_to_such_only(page: Path) -> None:
    targets = [link for link in LINK.findall(prose(page)) if not link.startswith(OUTSIDE)]
    files = [(page.parent / link.partition("#")[0]).resolve() for link in targets]
    assert not [file for file in files if file != DOCS and DOCS not in file.parents]


def test_every_page_is_in_the_menu_of_the_site() -> None:
    menu = re.findall(r"[\w/]+\.md", (ROOT / "mkdocs.yml").read_text("utf-8").partition("nav:")[2])
    assert sorted(menu) == sorted(str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md"))


def test_the_front_door_is_short_and_honest() -> None:
    text = (ROOT / "README.md").read_text("utf-8")
    assert len(text.splitlines()) <= MOST_LINES
    for needed in ("make demo", "make test", "never flown on a real drone", "](docs/viewer.jpg)"):
        assert needed in text


def test_files_and_pages_that_texts_name_are_there() -> None:
    """`companion/…`, `tests/…`, docs/….md and so on; braces and stars are patterns."""
    missing = []
    path = re.compile(
        r"(?<![\w/.\-])((?:companion|drivers|tests|docs|systemd|packaging|sample)/[\w./\-]*\w"
        r"\.(?:py|cl|md|sh|toml|svg|jpg|service|rules|npz))(?![\w/*{])"
    )
    for file in NAMED:
        if file.is_file() and file.name != "CHANGELOG.md":
            text = file.read_text("utf-8")
            missing += [f"{name_of(file)}: {each}" for each in path.findall(text)
                        if not (ROOT / each).exists()]  # fmt: skip
    assert not missing


def test_settings_in_texts_are_those_of_this_version(tmp_path: Path) -> None:
    old = []
    for file in [*PAGES, *ROOT.glob("systemd/*"), *ROOT.glob("packaging/**/*")]:
        if not file.is_file() or file.name == "CHANGELOG.md":
            continue
        text = file.read_text("utf-8")
        names = re.findall(r"(?<![\w.])[a-z]+\.[a-z][a-z0-9_]*", text)
        old += [f"{name_of(file)}: {name}" for name in names if current_key(name) != name]
        for block in re.findall(r"^ *```toml\n(.*?)^ *```$", text, re.M | re.S):
            (tmp_path / "block.toml").write_text(block, "utf-8")
            load_config(tmp_path / "block.toml", warn=old.append)
    assert not old


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_in_blocks_of_code_are_right(
    page: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As the parsers take them; brackets are optional parts, capitals stand for values."""
    parser, text = command_parser(), page.read_text("utf-8")
    wrong = []
    fenced = re.findall(r"^ *```(?:sh)?\n(.*?)^ *```$", text, re.M | re.S)
    indented = re.findall(r"\n\n((?:    .*\n|\n)+)", text)
    for line in "\n".join(fenced + indented).replace("\\\n", " ").splitlines():
        found = re.match(r" *(?:sudo )?(?:[\w./]+/)?companion (?!-)(.*)", line)
        if found is not None:
            command = re.sub(r"\[(--[^]]*)\]", r"\1", found[1].partition(" #")[0])
            words = [STANDS_FOR.get(word, word) for word in shlex.split(command)]
            try:
                parser.parse_args(words)
            except SystemExit:
                wrong.append(f"{line}: {capsys.readouterr().err.splitlines()[-1]}")
    assert not wrong


def test_the_page_of_commands_is_made_of_the_parsers() -> None:
    assert (DOCS / "commands.md").read_text("utf-8") == commands_page()


def test_each_argument_of_a_command_says_what_it_is() -> None:
    for name, text, parser in commands_of(command_parser()):
        assert text, name
        for each in arguments_of(parser):
            assert each.help and not each.help.startswith("("), f"{name}: {each.dest}"


def test_benchmarks_that_texts_name_are_there() -> None:
    for page in PAGES:
        for name in re.findall(r"tests\.bench\.(\w+)", page.read_text("utf-8")):
            places = ROOT / f"tests/bench/{name}.py", ROOT / f"tests/bench/{name}/__main__.py"
            assert any(place.exists() for place in places), f"{name_of(page)}: {name}"


def test_changes_are_told_by_version() -> None:
    text = (ROOT / "CHANGELOG.md").read_text("utf-8")
    versions = re.findall(r"^## \[([^\]]+)\](?: - (\d{4}-\d\d-\d\d))?$", text, re.M)
    assert next(name for name, _ in versions) == "Unreleased"
    assert __version__ in [name for name, day in versions if day]
    kinds = set(re.findall(r"^### (.+)$", text, re.M))
    assert kinds <= {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}
