"""What a browser is answered: the page, its door, its WebSocket, reports and metrics."""

from __future__ import annotations

import asyncio
import json
import sys
import time
import traceback
from collections.abc import Awaitable, Callable, Mapping
from http import HTTPStatus
from importlib.resources import files
from typing import Any, NamedTuple

from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

from pneud.report.frame import asset
from pneud.web.admission import Door, Session
from pneud.web.axis import Axis, statuses_of
from pneud.web.hand import Hand
from pneud.web.live import Gallery, Page
from pneud.web.metrics import OPENMETRICS, TEXT, text_of
from pneud.web.programs import Programs
from pneud.web.reports import ReportError, Reports

LONGEST = 4096  # bytes of what a page may say at once
_OPEN = (
    "/",
    "/page.js",
    "/page.css",
    "/uplot.js",
    "/uplot.css",
    "/icon.svg",
    "/session",
)  # to who has yet to enter
_PAGE = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self';"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# a report has its scripts inside, so it gets an origin of its own, to which nothing here answers
_REPORT = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:;"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'none'; sandbox allow-scripts allow-downloads"
)
_HEADERS = {
    "Content-Security-Policy": _PAGE,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
    "Cache-Control": "no-store",
}

_Answer = Callable[[Request], Awaitable[Response]]


class Shown(NamedTuple):
    """An axis that pages show."""

    axis: Axis
    gallery: Gallery
    hand: Callable[[Any], Hand]


class Pages:
    """What is behind the door."""

    def __init__(self, shown: Mapping[str, Shown], door: Door, reports: Reports, programs: Programs) -> None:
        """Nobody has come.

        Args:
            shown: the axes by their names; who names none sees the first.
            door: who comes in.
            reports: of their logs.
            programs: that they may go through.
        """
        self._shown = shown
        self._door = door
        self._reports = reports
        self._programs = programs

    def _asked_for(self, asked: Request | WebSocket) -> Shown | None:
        """The axis that a page shows, by `?axis=NAME`; None where there is no such axis."""
        name = asked.query_params.get("axis")
        return next(iter(self._shown.values())) if name is None else self._shown.get(name)

    def app(self) -> ASGIApp:
        """What a server calls."""
        routes = [
            Route("/", _file("page.html", "text/html")),
            Route("/page.js", _file("page.js", "text/javascript")),
            Route("/page.css", _file("page.css", "text/css")),
            Route("/icon.svg", _file("icon.svg", "image/svg+xml")),
            Route("/uplot.js", _given(asset("uPlot.iife.min.js"), "text/javascript")),
            Route("/uplot.css", _given(asset("uPlot.min.css"), "text/css")),
            Route("/session", self.enter, methods=["POST"]),
            Route("/logs", self.logs),
            Route("/programs", self.programs),
            Route("/reports/{name}", self.report),
            Route("/metrics", self.metrics),
            WebSocketRoute("/live", self.live),
        ]
        return Guard(Starlette(routes=routes), self._door)

    async def enter(self, request: Request) -> Response:
        """A session for whoever knows the secret."""
        if request.headers.get("content-type", "") != "application/json":
            return _line(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "say it in JSON")
        said = b""
        async for part in request.stream():
            said += part
            if len(said) > LONGEST:
                return _line(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "say less")
        try:
            secret = json.loads(said)["secret"]
        except (ValueError, TypeError, KeyError, RecursionError):
            return _line(HTTPStatus.BAD_REQUEST, "say the secret")
        door = self._door
        found = door.enter(secret, request.client.host if request.client else "", time.monotonic())
        if not isinstance(found, Session):
            return _line(*found)
        answer = JSONResponse({"key": found.key if door.operate else ""})
        answer.set_cookie(
            door.cookie_name, found.cookie, httponly=True, samesite="strict", secure=door.place.tls, path="/"
        )
        return answer

    async def logs(self, request: Request) -> Response:
        """What logs there are."""
        shown = self._asked_for(request)
        if shown is None:
            return _line(HTTPStatus.NOT_FOUND, f"no such axis; there is {', '.join(self._shown)}")
        log = (shown.axis.status or {}).get("log")
        return JSONResponse({"logs": await self._reports.list(log)})

    async def programs(self, _: Request) -> Response:
        """What programs there are."""
        found = await asyncio.to_thread(self._programs.listed)
        return JSONResponse({"programs": [one._asdict() for one in found]})

    async def report(self, request: Request) -> Response:
        """A report, made where there is none yet; other places cannot have one made."""
        if request.headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
            return _line(HTTPStatus.FORBIDDEN, "reports are made for this page alone")
        try:
            text = await self._reports.page(request.path_params["name"])
        except ReportError as e:
            return _line(HTTPStatus.NOT_FOUND, str(e))
        return HTMLResponse(text, headers={"Content-Security-Policy": _REPORT})

    async def metrics(self, request: Request) -> Response:
        """The facts of the status, in the dialect that is asked for."""
        openmetrics = "application/openmetrics-text" in request.headers.get("accept", "")
        text = text_of(statuses_of(shown.axis for shown in self._shown.values()), openmetrics)
        return Response(text, headers={"Content-Type": OPENMETRICS if openmetrics else TEXT})

    async def live(self, socket: WebSocket) -> None:
        """A page's pictures and orders."""
        shown = self._asked_for(socket)
        if shown is None or shown.gallery.full:
            await socket.close()
            return
        await socket.accept()
        page = Page(socket, shown.gallery, shown.axis, shown.hand)
        await page.serve(self._door.may_command)


class Guard:
    """Asks who comes, before anybody else does, and says to browsers what they may do with an answer."""

    def __init__(self, app: ASGIApp, door: Door) -> None:
        self._app = app
        self._door = door

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or have it answered."""
        headers = Headers(scope=scope)
        said = {name: headers.getlist(name) for name in ("host", "origin", "cookie", "authorization")}
        refusal = self._door.refusal(said)
        if refusal is None and scope["path"] not in _OPEN and not self._door.may_look(said):
            refusal = HTTPStatus.UNAUTHORIZED, "give the password on the page first"
        if scope["type"] == "websocket":
            if refusal is not None:
                await receive()
                await send({"type": "websocket.close"})
                return
            await self._safely(self._app, scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                there = {name.lower() for name, _ in message["headers"]}
                message["headers"] += [
                    (name.lower().encode(), value.encode())
                    for name, value in _HEADERS.items()
                    if name.lower().encode() not in there
                ]
            await send(message)

        app = self._app if refusal is None else _line(*refusal)
        await self._safely(app, scope, receive, with_headers)

    async def _safely(self, app: ASGIApp, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await app(scope, receive, send)
        except Exception:
            traceback.print_exc(limit=-8, file=sys.stderr)


def _line(status: HTTPStatus, words: str) -> Response:
    return PlainTextResponse(f"pneud: {words}\n", status.value)


def _file(name: str, kind: str) -> _Answer:
    return _given((files("pneud.web") / "assets" / name).read_text(encoding="utf-8"), kind)


def _given(text: str, kind: str) -> _Answer:
    async def answer(_: Request) -> Response:
        return Response(text, media_type=kind)

    return answer
