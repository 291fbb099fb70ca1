"""Who may look at the page, who may change things, and when nobody may."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from companion.page.codes import new_codes, read_codes, write_codes
from tests.support.served_page import ELSEWHERE, HERE, ServedPage

VIEWS = ("/", "/map", "/flights", "/setup", "/settings", "/now/panel", "/setup/steps")
CHANGES = (
    "/settings", "/settings/undo", "/restart", "/setup/examine", "/setup/parameter",
    "/flights/00001-2026-11-20T10-00-00Z/delete", "/flights/00001-2026-11-20T10-00-00Z/keep",
)  # fmt: skip


@pytest.fixture
def served(tmp_path: Path) -> Iterator[ServedPage]:
    with ServedPage(tmp_path) as served:
        yield served


def test_on_this_machine_one_looks_on_without_a_code(served: ServedPage) -> None:
    for view in VIEWS:
        answer = served.ask("GET", view, headers={"host": "localhost:9880"})
        assert answer.status == 200, view
        assert answer.headers["content-security-policy"].startswith("default-src 'self'")
        assert answer.headers["cache-control"] == "no-store"


def test_from_elsewhere_nothing_is_seen_without_a_code(served: ServedPage) -> None:
    for view in VIEWS:
        answer = served.ask("GET", view, peer=ELSEWHERE)
        assert answer.status == 303 and answer.headers["location"].startswith("/pair"), view
    for path in ("/now/picture", "/now/above"):
        answer = served.ask("GET", path, peer=ELSEWHERE, headers={"accept": "*/*"})
        assert answer.status == 401
    assert "tracking" not in served.ask("GET", "/pair", peer=ELSEWHERE).text.lower()


def test_a_code_that_is_typed_otherwise_is_the_same(served: ServedPage) -> None:
    code = served.codes.look
    headers = served.paired(f" {code[:4].lower()}-{code[4:]} ")
    assert served.ask("GET", "/", peer=ELSEWHERE, headers=headers).status == 200


def test_the_code_to_look_on_changes_nothing(served: ServedPage) -> None:
    headers = served.paired(served.codes.look)
    for path in CHANGES:
        answer = served.ask("POST", path, peer=ELSEWHERE, headers=headers, form={"token": "x"})
        assert answer.status == 403 and "look on only" in answer.text, path


def test_nor_does_anybody_on_this_machine_without_a_code(served: ServedPage) -> None:
    for path in CHANGES:
        assert served.ask("POST", path, peer=HERE, form={"token": ""}).status == 403, path


def test_a_session_cannot_be_made_up_or_raised(served: ServedPage) -> None:
    cookie = served.paired(served.codes.look)["cookie"]
    name, _, value = cookie.partition("=")
    for forged in (value[:-2] + "xx", value.replace("W", "X", 1), "WzIsImEiXQ", "", "." * 50):
        answer = served.ask("GET", "/", peer=ELSEWHERE, headers={"cookie": f"{name}={forged}"})
        assert answer.status == 303


def test_a_cookie_is_of_this_site_and_no_script_reads_it(served: ServedPage) -> None:
    answer = served.ask("POST", "/pair", peer=ELSEWHERE, form={"code": served.codes.change})
    words = answer.headers["set-cookie"].lower()
    assert "httponly" in words and "samesite=strict" in words


@pytest.mark.parametrize("headers", [
    {"origin": "http://evil.example"},
    {"origin": "null"},
    {"sec-fetch-site": "cross-site"},
])  # fmt: skip
def test_forms_of_other_sites_are_refused(served: ServedPage, headers: dict[str, str]) -> None:
    session, token = served.changer()
    form = {"token": token, "depth.enabled": "false"}
    answer = served.ask("POST", "/settings", peer=ELSEWHERE, headers=session | headers, form=form)
    assert answer.status == 403 and served.config.read_text() == ""
    pairing = served.ask("POST", "/pair", peer=ELSEWHERE, headers=headers, form={"code": "x"})
    assert pairing.status == 403


def test_forms_without_the_token_of_the_session_are_refused(served: ServedPage) -> None:
    session, token = served.changer()
    other, _ = served.changer()
    for headers, given in ((session, ""), (session, token[:-1] + "x"), (other, token)):
        form = {"token": given, "depth.enabled": "false"}
        answer = served.ask("POST", "/settings", peer=ELSEWHERE, headers=headers, form=form)
        assert answer.status == 403 and "old one" in answer.text
    assert served.config.read_text() == ""


def test_nothing_is_changed_while_armed(
    served: ServedPage, capsys: pytest.CaptureFixture[str]
) -> None:
    session, token = served.changer()
    served.status["armed"] = True
    for path in CHANGES:
        form = {"token": token, "depth.enabled": "false"}
        answer = served.ask("POST", path, peer=ELSEWHERE, headers=session, form=form)
        assert answer.status == 409 and "motors are armed" in answer.text, path
    assert served.config.read_text() == "" and capsys.readouterr().out == ""
    assert "only looks on" in served.ask("GET", "/", peer=ELSEWHERE, headers=session).text


def test_nor_where_nobody_knows_whether_they_are(served: ServedPage) -> None:
    session, token = served.changer()
    del served.status["armed"]
    form = {"token": token, "depth.enabled": "false"}
    answer = served.ask("POST", "/settings", peer=ELSEWHERE, headers=session, form=form)
    assert answer.status == 409 and served.config.read_text() == ""


def test_codes_are_not_guessed(served: ServedPage) -> None:
    answers = [
        served.ask("POST", "/pair", peer=ELSEWHERE, form={"code": f"AAAA-{n:04}"}).status
        for n in range(8)
    ]
    assert answers == [403] * 5 + [429] * 3
    right = {"code": served.codes.change}
    assert served.ask("POST", "/pair", peer=ELSEWHERE, form=right).status == 429
    served.now_s = 15.0
    assert served.ask("POST", "/pair", peer=ELSEWHERE, form=right).status == 303


def test_nor_from_many_addresses(served: ServedPage) -> None:
    answers = [
        served.ask("POST", "/pair", peer=f"10.0.{n}.1", form={"code": "AAAA"}).status
        for n in range(40)
    ]
    assert answers.count(403) <= 21


def test_new_codes_end_all_sessions(served: ServedPage) -> None:
    headers = served.paired(served.codes.look)
    write_codes(served.flights, new_codes())
    assert served.ask("GET", "/", peer=ELSEWHERE, headers=headers).status == 303
    assert served.paired(served.codes.look)


def test_codes_are_kept_by_a_service_that_may_change_no_owner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As systemd confines it: SystemCallFilter=~@privileged."""

    def refused(*_: int) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "fchown", refused)
    for codes in (new_codes(), new_codes()):
        write_codes(tmp_path, codes)
        assert read_codes(tmp_path) == codes


def test_codes_are_kept_for_owner_and_group_alone(served: ServedPage) -> None:
    (path,) = served.flights.glob(".page-codes*")
    assert path.stat().st_mode & 0o7777 == 0o640


def test_one_goes_on_to_paths_of_this_page_only(served: ServedPage) -> None:
    for to in ("//evil.example", "http://evil.example", "/\\evil.example"):
        form = {"code": served.codes.look, "to": to}
        answer = served.ask("POST", "/pair", peer=ELSEWHERE, form=form)
        assert answer.headers["location"] == "/"
        served.now_s += 60.0


def test_names_of_other_sites_that_lead_here_are_refused(served: ServedPage) -> None:
    for host in ("evil.example", "evil.example:9880", "127.0.0.1.evil.example"):
        assert served.ask("GET", "/", peer=HERE, headers={"host": host}).status == 421
    for host in ("127.0.0.1:9880", "[::1]:9880", "localhost"):
        assert served.ask("GET", "/", peer=HERE, headers={"host": host}).status == 200


def test_a_token_of_other_letters_is_a_wrong_one(served: ServedPage) -> None:
    headers = served.paired(served.codes.change)
    answer = served.ask("POST", "/restart", peer=ELSEWHERE, headers=headers, form={"token": "ä"})
    assert answer.status == 403


def test_a_number_of_thousands_of_digits_is_none(served: ServedPage) -> None:
    long = "9" * 5000
    answer = served.ask("GET", f"/now/picture?after={long}", headers={"host": "localhost"})
    assert answer.status == 204
    headers, token = served.changer()
    asked = {"token": token, "number": long}
    answer = served.ask("POST", "/settings/undo", peer=ELSEWHERE, headers=headers, form=asked)
    assert answer.status == 409
