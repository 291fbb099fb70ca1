"""View Settings: every key with its text and bounds, what was changed, undo, restart."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, get_type_hints

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from companion.config import Config
from companion.config.passwords import HIDDEN, without_passwords
from companion.config.setting_keys import dump, listed_words_of, value_of_key, words_of
from companion.daemon.control.reload import needs_restart
from companion.errors import ConfigError
from companion.page.setting_texts import PURPOSES, Setting, settings
from companion.page.settings_file import Change, SettingsFile, shown_value, value_of_text
from companion.page.views.site import Form, RefusedError, Site, is_number

SHOWN_CHANGES = 20
BY_HAND = "companion was started by hand, and nothing would start it again: do so by hand."


@dataclass(frozen=True, slots=True)
class Field:
    """A key in the form."""

    setting: Setting
    kind: str
    """choice, number or text."""
    value: str
    choices: tuple[str, ...]
    least: str
    most: str
    needs_restart: bool
    overridden: bool
    """Given on the command line: the file does not count."""
    wrong: str = ""

    @property
    def is_default(self) -> bool:
        """True of a value that is the one without any setting."""
        return self.value == self.setting.default.strip('"')


class SettingViews:
    """See the module."""

    def __init__(self, site: Site) -> None:
        self._site = site
        self._file = SettingsFile(site.facts.path, site.flights)

    def routes(self) -> list[Route]:
        """Routes of this view."""
        looking, changing = self._site.looking, self._site.changing
        return [
            Route("/settings", looking(self._show)),
            Route("/settings", changing(self._save), methods=["POST"]),
            Route("/settings/undo", changing(self._undo), methods=["POST"]),
            Route("/restart", changing(self._restart), methods=["POST"]),
        ]

    def fields(self, names: tuple[str, ...]) -> list[Field]:
        """Fields of some keys, for the form of another view; ConfigError."""
        config = self._site.facts.configured()
        sections = {name.split(".")[0] for name in names}
        known = {each.name: each for section in sections for each in settings(section, False)}
        return [self._field(known[name], config, {}, {}) for name in names]

    async def _show(self, request: Request) -> Response:
        return await self._page(request, {}, {})

    async def _save(self, request: Request, form: Form) -> Response:
        to = form.get("to", "/settings")
        to = to if to in ("/settings", "/setup", "/settings?expert=1") else "/settings"
        now = dump(await asyncio.to_thread(self._site.facts.configured))
        wanted: dict[str, Any] = {}
        wrong: dict[str, str] = {}
        for name, text in form.items():
            if name not in now or text == shown_value(now[name]):
                continue
            if HIDDEN in text:
                wrong[name] = "its password is not shown here: type it again"
                continue
            try:
                value = value_of_text(name, text)
            except ConfigError as error:
                wrong[name] = str(error).partition(f"{name}: ")[2] or str(error)
                continue
            if value != now[name]:
                wanted[name] = value
        if wrong:
            return await self._page(request, dict(form), wrong, 422)
        if not wanted:
            return self._site.done(request, to, "Nothing was changed.")
        return await self.keep(request, to, wanted)

    async def keep(self, request: Request, to: str, wanted: Mapping[str, Any]) -> Response:
        """Set keys in the file, and go to a view; ConfigError."""
        changes = await asyncio.to_thread(self._file.set, wanted)
        return self._taken_over(request, to, changes)

    async def _undo(self, request: Request, form: Form) -> Response:
        number = form.get("number", "")
        changes = await asyncio.to_thread(self._file.undo, int(number) if is_number(number) else -1)
        return self._taken_over(request, "/settings", changes)

    async def _restart(self, request: Request, form: Form) -> Response:
        if not self._site.facts.supervised:
            raise RefusedError(BY_HAND)
        self._site.watch.order("restart")
        return await self._site.render(request, "restart.html.j2")

    def _taken_over(self, request: Request, to: str, changes: list[Change]) -> Response:
        self._site.watch.order("reload")
        said = "Changed: " + "; ".join(
            f"{each.name} is now {_shown(each.after) or 'the default'}" for each in changes
        )
        if any(needs_restart(each.name) for each in changes):
            said += ". It counts after a restart"
        return self._site.done(request, to, said + ".")

    async def _page(
        self, request: Request, given: Form, wrong: dict[str, str], status_code: int = 200
    ) -> Response:
        expert = "expert" in request.query_params or any(n.startswith("expert.") for n in given)
        config = await asyncio.to_thread(self._site.facts.configured)
        groups = []
        purposes = {"Expert": tuple(get_type_hints(Config))} if expert else PURPOSES
        for purpose, sections in purposes.items():
            shown = [
                (
                    section,
                    [self._field(each, config, given, wrong) for each in settings(section, expert)],
                )
                for section in sections
            ]
            groups.append((purpose, [(name, fields) for name, fields in shown if fields]))
        changes = await asyncio.to_thread(self._shown_changes)
        return await self._site.render(
            request, "settings.html.j2", status_code, groups=groups, expert=expert,
            file=self._site.facts.path, changes=changes,
            n_wrong=len(wrong), waiting=self.waiting(config),
            supervised=self._site.facts.supervised,
        )  # fmt: skip

    def _shown_changes(self) -> list[Change]:
        """The newest changes first, without passwords."""
        newest = reversed(self._file.changes()[-SHOWN_CHANGES:])
        return [Change(c.number, c.name, _shown(c.before), _shown(c.after)) for c in newest]

    def waiting(self, config: Config) -> list[str]:
        """Keys whose value in the file counts after a restart only."""
        began = dump(self._site.facts.config)
        return [
            name
            for name, value in dump(config).items()
            if value != began[name] and needs_restart(name)
        ]

    def _field(self, setting: Setting, config: Config, given: Form, wrong: dict[str, str]) -> Field:
        value = value_of_key(config, setting.name)
        choices = ("true", "false") if isinstance(value, bool) else words_of(setting.name)
        least, _, most = setting.values.partition(" to ")
        is_number = bool(most) and not isinstance(value, str) and not listed_words_of(setting.name)
        kind = "choice" if choices else "number" if is_number else "text"
        shown = given.get(setting.name, shown_value(value))
        return Field(
            setting, kind, shown, choices, least if is_number else "", most if is_number else "",
            needs_restart(setting.name), setting.name in self._site.facts.overridden,
            wrong.get(setting.name, ""),
        )  # fmt: skip


def _shown(toml: str | None) -> str | None:
    return None if toml is None else without_passwords(toml)
