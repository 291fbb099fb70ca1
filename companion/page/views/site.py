"""Parts that all views share: sessions and rights, the templates, and changes while disarmed."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, quote, urlsplit

from jinja2 import Environment, PackageLoader, StrictUndefined
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response

from companion import __version__
from companion.errors import CompanionError, FlightError
from companion.page.access import COOKIE, Access, Right, Session
from companion.page.daemon_watch import DaemonWatch
from companion.page.facts import Facts
from companion.page.scene import Scene

View = Callable[[Request], Awaitable[Response]]
Form = Mapping[str, str]
Change = Callable[[Request, Form], Awaitable[Response]]
ARMED = "The motors are armed: nothing is changed from the page until they are disarmed."
NOT_KNOWN = "companion does not answer, so that nobody knows whether the motors are armed."
LOOKS_ON = "This device may look on only. Pair it with the code to change things."
MOST_SAID = 64
"""Messages that wait for the view that shows them."""
MOST_DIGITS = 18
"""Of a number in a request: Python refuses to read thousands of them."""
FOREIGN_FORM = "This form did not come from this page."
OWN_SITE = ("same-origin", "none")
"""Values of Sec-Fetch-Site for forms of this page."""


class RefusedError(Exception):
    """A view is refused to its reader, who is told why."""

    def __init__(self, why: str, status_code: int = 409) -> None:
        super().__init__(why)
        self.status_code = status_code


class Site:
    """See the module. `flights` is the folder of the flights."""

    def __init__(
        self, facts: Facts, flights: Path, access: Access, watch: DaemonWatch, scene: Scene
    ) -> None:
        self.facts, self.flights = facts, flights
        self.access, self.watch, self.scene = access, watch, scene
        self._said: OrderedDict[str, tuple[str, bool]] = OrderedDict()
        self._templates = Environment(
            loader=PackageLoader("companion.page", "templates"), autoescape=True,
            undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        )  # fmt: skip

    def session(self, request: Request) -> Session:
        """Session of a request."""
        peer = request.client.host if request.client is not None else ""
        return self.access.session(request.cookies.get(COOKIE), peer)

    def looking(self, view: View) -> View:
        """A view for whoever may look on; RefusedError and errors of ours become its answer."""

        async def checked(request: Request) -> Response:
            if self.session(request).right < Right.LOOK:
                if request.headers.get("accept", "").startswith("text/html"):
                    return RedirectResponse(f"/pair?to={quote(request.url.path)}", 303)
                return PlainTextResponse("pair this device first, at /pair", 401)
            return await self._answer(request, view(request))

        return checked

    def changing(self, change: Change) -> View:
        """A change by whoever may change things, with a form of this page, while disarmed.

        It answers as one by `looking` does.
        """

        async def checked(request: Request) -> Response:
            form = await read_form(request)
            session = self.session(request)
            if form is None or not is_same_origin(request):
                raise RefusedError(FOREIGN_FORM, 403)
            if session.right < Right.CHANGE:
                raise RefusedError(LOOKS_ON, 403)
            if not self.access.is_token(session, form.get("token", "")):
                raise RefusedError("This form is an old one. Open it again.", 403)
            if await self.watch.is_armed():
                raise RefusedError(ARMED if not self.watch.problem else NOT_KNOWN)
            return await change(request, form)

        async def answered(request: Request) -> Response:
            return await self._answer(request, checked(request))

        return answered

    async def _answer(self, request: Request, answer: Awaitable[Response]) -> Response:
        try:
            return await answer
        except RefusedError as refused:
            return await self.refused(request, str(refused), refused.status_code)
        except CompanionError as error:
            missing = isinstance(error, FlightError) and request.method != "POST"
            return await self.refused(request, str(error), 404 if missing else 409)

    async def render(
        self, request: Request, template: str, status_code: int = 200, **values: Any
    ) -> Response:
        """A template with what all have: the session, the navigation, and what was said."""
        session = self.session(request)
        said = self._said.pop(session.name, None) if session.name else None
        status = await self.watch.status()
        html = self._templates.get_template(template).render(
            version=__version__, path=request.url.path, may_look=session.right >= Right.LOOK,
            may_change=session.right >= Right.CHANGE, token=self.access.token(session), said=said,
            armed=status.get("armed"), status=status, problem=self.watch.problem, **values,
        )  # fmt: skip
        return HTMLResponse(html, status_code)

    def part(self, template: str, **values: Any) -> str:
        """A template that shows the same to all, and is part of a view."""
        return self._templates.get_template(template).render(**values)

    async def refused(self, request: Request, why: str, status_code: int) -> Response:
        """A page that says why something was not done."""
        missing = status_code == 404
        return await self.render(request, "refused.html.j2", status_code, why=why, missing=missing)

    def done(self, request: Request, to: str, what: str = "", good: bool = True) -> Response:
        """Go to a view, which says what was done unless it shows that by itself."""
        name = self.session(request).name
        if name and what:
            self._said[name] = (what, good)
            if len(self._said) > MOST_SAID:
                self._said.popitem(last=False)
        return RedirectResponse(to, 303)


async def read_form(request: Request) -> Form | None:
    """Fields of a form; None where it is none, or too long."""
    if not request.headers.get("content-type", "").startswith("application/x-www-form-urlencoded"):
        return None
    try:
        body = await request.body()
        return dict(parse_qsl(body.decode(), keep_blank_values=True, max_num_fields=400))
    except (ClientDisconnect, ValueError):
        return None


def is_number(text: str) -> bool:
    """True of a whole number of a request that is not longer than any of ours."""
    return text.isdecimal() and len(text) <= MOST_DIGITS


def is_same_origin(request: Request) -> bool:
    """False of a form that another site has sent, as far as browsers say; they all do."""
    origin = request.headers.get("origin")
    if origin is not None:
        return urlsplit(origin).netloc == request.headers.get("host")
    return request.headers.get("sec-fetch-site", "same-origin") in OWN_SITE


def local_path(to: str) -> str:
    """A path of this page to go to; "/" for anything else."""
    return to if to.startswith("/") and not to.startswith(("//", "/\\")) else "/"
