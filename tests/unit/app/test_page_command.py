"""`companion page`: where the page is, and its codes."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import pytest

from companion.app.page_command import show_page
from companion.config import Config
from companion.config_file import load_config
from companion.errors import SourceError
from companion.page.codes import shown
from tests.support.served_page import ServedPage


@pytest.fixture
def served(tmp_path: Path) -> Iterator[ServedPage]:
    with ServedPage(tmp_path) as served:
        served.status |= {"page": "127.0.0.1:9880", "flights": str(served.flights)}
        yield served


def asked(served: ServedPage) -> Config:
    return load_config(None, [f"expert.daemon.socket={served.folder}/run/status.sock"])


def test_address_and_codes_are_shown(served: ServedPage) -> None:
    out = io.StringIO()
    show_page(asked(served), out, renew=False)
    lines = out.getvalue().splitlines()
    assert lines[0] == "http://127.0.0.1:9880"
    assert lines[1].endswith(shown(served.codes.look))
    assert lines[2].endswith(shown(served.codes.change))


def test_at_every_network_it_is_at_the_addresses_of_this_machine(served: ServedPage) -> None:
    served.status["page"] = "0.0.0.0:9880"
    out = io.StringIO()
    show_page(asked(served), out, renew=False)
    assert ".local:9880" in out.getvalue() and "0.0.0.0" not in out.getvalue()


def test_new_codes_are_others(served: ServedPage) -> None:
    before = served.codes
    show_page(asked(served), io.StringIO(), renew=True)
    after = served.codes
    assert not {before.look, before.change, before.secret} & {
        after.look, after.change, after.secret,
    }  # fmt: skip


def test_without_a_page_it_says_so(served: ServedPage, tmp_path: Path) -> None:
    served.status["page"] = ""
    with pytest.raises(SourceError, match="serves no page"):
        show_page(asked(served), io.StringIO(), renew=False)
    with pytest.raises(SourceError, match="no daemon runs"):
        show_page(load_config(None, [f"expert.daemon.socket={tmp_path}/no.sock"]), io.StringIO(),
                  renew=False)  # fmt: skip
