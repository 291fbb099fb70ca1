"""Open to everybody: pairing of a device by a code, the end of its session, our name for BlueOS."""

from __future__ import annotations

from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.routing import Route

from companion import __version__
from companion.page.access import COOKIE, KEPT_S
from companion.page.views.site import Site, is_same_origin, local_path, read_form

WRONG = "This is not one of the two codes."
TOO_OFTEN = "Too many attempts: wait half a minute."


class PairingViews:
    """See the module."""

    def __init__(self, site: Site) -> None:
        self._site = site

    def routes(self) -> list[Route]:
        """Routes of this view; they are open to everybody."""
        return [
            Route("/pair", self._ask),
            Route("/pair", self._pair, methods=["POST"]),
            Route("/leave", self._leave, methods=["POST"]),
            Route("/register_service", self._service),
        ]

    async def _ask(self, request: Request) -> Response:
        return await self._form(request, request.query_params.get("to", "/"), "")

    async def _pair(self, request: Request) -> Response:
        form = await read_form(request)
        if form is None or not is_same_origin(request):
            return await self._site.refused(request, "This form did not come from this page.", 403)
        to, peer = local_path(form.get("to", "/")), request.client.host if request.client else ""
        try:
            cookie = self._site.access.pair(form.get("code", "")[:64], peer)
        except PermissionError:
            return await self._form(request, to, TOO_OFTEN, 429)
        if cookie is None:
            return await self._form(request, to, WRONG, 403)
        answer = RedirectResponse(to, 303)
        answer.set_cookie(COOKIE, cookie, KEPT_S, httponly=True, samesite="strict")
        return answer

    async def _leave(self, request: Request) -> Response:
        if not is_same_origin(request):
            return await self._site.refused(request, "This form did not come from this page.", 403)
        answer = RedirectResponse("/pair", 303)
        answer.delete_cookie(COOKIE, httponly=True, samesite="strict")
        return answer

    async def _service(self, request: Request) -> Response:
        """Name and version for BlueOS, which asks for them at the ports of this machine."""
        return JSONResponse({
            "name": "companion", "description": "Vision position, map and video for the autopilot",
            "icon": "mdi-map-marker-path", "company": "companion", "version": __version__,
            "webpage": "", "api": "", "new_page": True,
        })  # fmt: skip

    async def _form(
        self, request: Request, to: str, wrong: str, status_code: int = 200
    ) -> Response:
        return await self._site.render(
            request, "pair.html.j2", status_code, to=local_path(to), wrong=wrong
        )
