"""The server of the live page: on this machine alone, unless it is told otherwise, and for those who have the address.

Every request goes through `Guarded.find_handler`. Its Host must be this machine's (else a page of somebody else whose
name leads here could read along), its Origin, where a browser names one, the page's own, and beyond this machine the
page needs the token of the address. All that is done is done by way of the page's websocket, which takes only sessions
that this server has signed when it gave out the page.
"""

import hmac
import ipaddress
import secrets
import socket
from collections.abc import Callable
from urllib.parse import parse_qs, urlsplit

from bokeh.application import Application
from bokeh.application.handlers import FunctionHandler
from bokeh.document import Document
from bokeh.resources import Resources
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.util.token import check_token_signature
from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPServerRequest
from tornado.ioloop import IOLoop, PeriodicCallback
from tornado.netutil import bind_sockets
from tornado.web import ErrorHandler, RequestHandler

from cosim.view.budget import Budget
from nmfd.errors import InputError

LOOPBACK = "127.0.0.1"
MOST_VIEWERS = 12  # at a time
RETRY = 5  # s, until somebody for whom there is no room asks again
LARGEST = 1_000_000  # bytes of a message to the server
LEFT = 5.0  # s without a viewer, after which nobody is looking


class Guarded(BokehTornado):
    """Bokeh's server behind a guard. token: what the page's address needs, "" on this machine alone."""

    def __init__(self, application: Application, names: frozenset[str], token: str, budget: Budget):
        """names: of this machine, as a Host may have them, besides addresses where there is a token; budget: of pages
        and pictures"""
        self._names, self._token, self._budget = names, token, budget
        super().__init__(
            application,
            extra_websocket_origins=["*"],
            sign_sessions=True,
            secret_key=secrets.token_bytes(32),
            websocket_max_message_size_bytes=LARGEST,
            unused_session_lifetime_milliseconds=int(1000 * LEFT),
            check_unused_sessions_milliseconds=1000,
            keep_alive_milliseconds=10_000,
            use_index=False,
        )

    def find_handler(self, request: HTTPServerRequest, **more: object) -> object:
        """403 instead of an answer, unless all is well; a page that asks again where too many look."""
        if not self.allowed(request):
            return self.get_handler_delegate(request, ErrorHandler, {"status_code": 403})
        if not _free(request.path) and not self.room():
            return self.get_handler_delegate(request, Waiting)
        return super().find_handler(request, **more)

    def resources(self, absolute_url: str | bool | None = None) -> Resources:
        """Without Bokeh's scripts for formulas, tables and WebGL: nothing on the page needs them, and a browser
        would read them first."""
        return super().resources(absolute_url).clone(components=["bokeh", "bokeh-widgets"])

    def room(self) -> bool:
        """Whether a page may be made now."""
        return len(self.get_sessions("/")) < MOST_VIEWERS and self._budget.page()

    def allowed(self, request: HTTPServerRequest) -> bool:
        """Whether a request may have an answer."""
        host = request.headers.get_list("Host")
        if len(host) != 1 or not self._known(_name(host[0])):
            return False
        origins = request.headers.get_list("Origin")
        if any(origin.lower() != f"http://{host[0].lower()}" for origin in origins):
            return False
        if request.path.rstrip("/") == "/ws":
            return self._signed(request.headers.get("Sec-WebSocket-Protocol", ""))
        if _free(request.path):
            return True
        given = parse_qs(request.query).get("token", [""])[-1]
        return not self._token or hmac.compare_digest(given.encode(), self._token.encode())

    def _signed(self, protocol: str) -> bool:
        """Whether a websocket is of a page that this server gave out: "bokeh, TOKEN"."""
        words = [word.strip() for word in protocol.split(",")]
        try:
            return len(words) == 2 and check_token_signature(words[1], secret_key=self.secret_key, signed=True)
        except (ValueError, KeyError, TypeError):  # anything may stand there
            return False

    def _known(self, name: str) -> bool:
        if name in self._names:
            return True
        return bool(self._token) and _is_address(name)


class Waiting(RequestHandler):
    """What costs next to nothing, for those for whom there is no room now."""

    def get(self) -> None:
        """A page that asks again."""
        self.set_status(503)
        self.set_header("Retry-After", str(RETRY))
        self.finish(
            f'<!DOCTYPE html><html lang="en"><meta charset="utf-8"><meta http-equiv="refresh" content="{RETRY}">'
            "<title>One moment</title><p>Many are watching, and the runs go first. This page asks again in "
            f"{RETRY} s."
        )


class Server:
    """Shows `page` to whoever opens `address`, in the thread that calls `serve`."""

    def __init__(
        self, page: Callable[[Document], object], *, host: str = LOOPBACK, port: int = 0, budget: Budget | None = None
    ):
        """port: 0 for any that is free; budget: of what pages and pictures cost. Raises InputError for a port that is
        not free, and a host that is not this machine's"""
        try:
            sockets = bind_sockets(port, host)
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise InputError(
                f"--host {host}, --port {port}: cannot be listened at ({reason}); choose another port, or omit --port "
                "for any that is free"
            ) from None
        self.port = sockets[0].getsockname()[1]
        local = all(_is_loopback(one.getsockname()[0]) for one in sockets)
        self._token = "" if local else secrets.token_urlsafe(24)
        names = {"localhost", LOOPBACK, "::1", host.lower()}
        if not local:
            names |= {socket.gethostname().lower(), socket.getfqdn().lower()}
        application = Application(FunctionHandler(page))
        self._loop = IOLoop.current()
        self._tornado = Guarded(application, frozenset(names), self._token, budget or Budget())
        http = HTTPServer(
            self._tornado, max_buffer_size=10 * LARGEST, max_body_size=LARGEST, idle_connection_timeout=60
        )
        http.add_sockets(sockets)
        self._server = BaseServer(self._loop, self._tornado, http)
        shown = host if host not in ("0.0.0.0", "::") else socket.gethostname()
        shown = f"[{shown}]" if ":" in shown else shown
        self.address = f"http://{shown}:{self.port}/" + (f"?token={self._token}" if self._token else "")

    @property
    def viewers(self) -> int:
        """How many look at the page, or did so a few seconds ago."""
        return len(self._tornado.get_sessions("/"))

    def serve(self, every: float, look: Callable[[], bool]) -> None:
        """Until `look`, asked every so many seconds, says that it is enough, or somebody presses Ctrl-C."""

        def ask() -> None:
            if look():
                self._loop.stop()

        asking = PeriodicCallback(ask, 1000.0 * every)
        self._server.start()
        asking.start()
        try:
            self._loop.start()
        finally:
            asking.stop()
            self._server.stop()
            self._server.unlisten()


def _free(path: str) -> bool:
    """Whether it costs next to nothing."""
    path = path.rstrip("/")
    return path.startswith("/static/") or path in ("/favicon.ico", "/ws")


def _name(host: str) -> str:
    """The name in a Host header, without its port; "" where there is none."""
    try:
        return (urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return ""


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _is_loopback(address: str) -> bool:
    return ipaddress.ip_address(address.partition("%")[0]).is_loopback
