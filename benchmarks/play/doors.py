"""A viser server that only the person who started it can use.

viser by itself listens on every address, asks for no token, looks at neither Host nor Origin, opens a public tunnel for
any client that asks, and takes files. Here it listens on the loopback address; every request needs a random token and
an exact Host, every WebSocket an exact Origin too; four kinds of messages are heard, all others are dropped unread;
messages are small, and clients few. The hooks are viser's private ones: its version is pinned, and each door is tested.
"""

import contextlib
import http
import ipaddress
import os
import secrets
import socket
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

import psutil
import viser
import viser._messages as messages
import viser.infra
import websockets.asyncio.server
from websockets import Headers
from websockets.http11 import Request, Response

from ash.files import InputError

# Camera, sliders and buttons, hot keys, and a click on a camera's frustum.
HEARD = (
    messages.ViewerCameraMessage,
    messages.GuiUpdateMessage,
    messages.CommandTriggerMessage,
    messages.SceneNodeClickMessage,
)
LARGEST_MESSAGE = 64 << 10  # bytes; a click is a few hundred
EVERYWHERE = ("0.0.0.0", "::")
SAFE_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": (
        "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; frame-ancestors 'none'; form-action 'none'"
    ),
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


@dataclass(frozen=True, kw_only=True, slots=True)
class DoorOptions:
    """Who may come in."""

    host: str = "127.0.0.1"
    port: int = 0  # 0: a free one
    clients: int = 8
    allow_origins: tuple[str, ...] = ()  # such as http://localhost:9000, where a port is forwarded
    expose: bool = False  # listen beyond the loopback address


@dataclass(kw_only=True, slots=True)
class Doors:
    """What is known once the server listens, and how many are inside."""

    options: DoorOptions
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    # Cookies know no ports, and another player may run on another.
    cookie: str = field(default_factory=lambda: f"ash_bench_{secrets.token_hex(4)}")
    origins: frozenset[str] = frozenset()
    inside: int = 0


def require_safe(options: DoorOptions) -> None:
    """Refuse to listen to other machines unless that was asked for, and origins that are none.

    Raises:
        InputError: says what `--expose` would mean.
    """
    if not options.expose and not _is_loopback(options.host):
        raise InputError(
            f"host: {options.host} is open to other machines; with --expose, whoever has the printed address can "
            "watch, and read it on the way, for nothing is encrypted; a forwarded port (ssh -L) is safer"
        )
    for origin in options.allow_origins:
        parts = urlsplit(origin)
        if parts.scheme not in ("http", "https") or not parts.hostname or f"{parts.scheme}://{parts.netloc}" != origin:
            raise InputError(f"allow-origin: expected http://HOST:PORT, got {origin!r}")


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def open_server(options: DoorOptions, *, label: str) -> tuple[viser.ViserServer, str, Doors]:
    """Start the server behind its doors; also the one address that opens them.

    Raises:
        InputError: the address is not safe or cannot be listened to.
    """
    require_safe(options)
    if options.port and not _is_free(options.host, options.port):
        raise InputError(f"port: {options.port} on {options.host} is taken; expected a free one (0: any)")
    doors = Doors(options=options)
    with _behind(doors), _silent():
        server = viser.ViserServer(host=options.host, port=options.port, label=label, verbose=False)
    port = server.get_port()
    doors.origins = frozenset({*_origins(options, port), *options.allow_origins})
    _hear_only(server)
    shown = "127.0.0.1" if options.host in EVERYWHERE else options.host
    return server, f"http://{_bracketed(shown)}:{port}/?token={doors.token}", doors


def close_server(server: viser.ViserServer) -> None:
    """Stop it and its threads."""
    with _silent():
        server.stop()


def _origins(options: DoorOptions, port: int) -> set[str]:
    """What a browser calls this server."""
    names = {options.host}
    if _is_loopback(options.host) or options.host in EVERYWHERE:
        names |= {"127.0.0.1", "localhost", "::1"}
    if options.host in EVERYWHERE:
        addresses = [address for each in psutil.net_if_addrs().values() for address in each]
        names |= {a.address.partition("%")[0] for a in addresses if a.family in (socket.AF_INET, socket.AF_INET6)}
        names |= {socket.gethostname()}
    return {f"http://{_bracketed(name)}:{port}" for name in names}


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _is_free(host: str, port: int) -> bool:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((host, port))
        except OSError:
            return False
    return True


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """viser announces its addresses, which lack the token."""
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):  # noqa: PTH123
        yield


@contextlib.contextmanager
def _behind(doors: Doors) -> Iterator[None]:
    """While the body starts a server, the doors are put before it."""
    serve = websockets.asyncio.server.serve

    def guarded(handler: Callable[[Any], Awaitable[None]], *args: Any, **options: Any) -> Any:
        page = options.pop("process_request")
        options["max_size"] = LARGEST_MESSAGE
        options["process_request"] = lambda connection, request: answer(doors, connection, request, page)
        return serve(_limited(doors, handler), *args, **options)

    websockets.asyncio.server.serve = guarded  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]


def _limited(doors: Doors, handler: Callable[[Any], Awaitable[None]]) -> Callable[[Any], Awaitable[None]]:
    async def enter(connection: Any) -> None:
        if doors.inside >= doors.options.clients:
            await connection.close(1013, f"{doors.options.clients} viewers are here already")
            return
        doors.inside += 1
        try:
            await handler(connection)
        finally:
            doors.inside -= 1

    return enter


def answer(doors: Doors, connection: Any, request: Request, page: Callable[[Any, Request], Any]) -> Response | None:
    """What a request gets: the page, a WebSocket (None), or the reason why neither."""
    reason = why_refused(doors, request)
    if reason is not None:
        return _plain(http.HTTPStatus.FORBIDDEN, reason)
    if _is_websocket(request):
        if doors.inside >= doors.options.clients:
            return _plain(http.HTTPStatus.SERVICE_UNAVAILABLE, "too many viewers")
        return None
    url = urlsplit(request.path)
    if url.path != "/":
        return _plain(http.HTTPStatus.NOT_FOUND, "there is one page: /")
    if url.query:  # The token goes into a cookie and out of the address bar.
        response = _plain(http.HTTPStatus.SEE_OTHER, "")
        response.headers["Location"] = "/"
        response.headers["Set-Cookie"] = f"{doors.cookie}={doors.token}; HttpOnly; SameSite=Lax; Path=/"
        return response
    response = page(connection, request)
    for name, value in SAFE_HEADERS.items():
        response.headers[name] = value
    return response


def why_refused(doors: Doors, request: Request) -> str | None:
    """In the order in which it is looked at: Host, Origin, token; None: it may come in."""
    headers = request.headers
    hosts = {urlsplit(origin).netloc for origin in doors.origins}
    if headers.get_all("Host") not in [[host] for host in hosts]:
        return "wrong Host: open the address that ash-bench play printed, or start it with --allow-origin"
    origins = headers.get_all("Origin")
    if (origins or _is_websocket(request)) and origins not in [[origin] for origin in doors.origins]:
        return "wrong Origin: start ash-bench play with --allow-origin if this address is yours"
    given = [*parse_qs(urlsplit(request.path).query).get("token", []), *_cookies(headers, doors.cookie)]
    if not any(secrets.compare_digest(token.encode(), doors.token.encode()) for token in given):
        return "wrong token: open the address that ash-bench play printed"
    return None


def _is_websocket(request: Request) -> bool:
    return any(value.strip().lower() == "websocket" for value in request.headers.get_all("Upgrade"))


def _cookies(headers: Headers, name: str) -> list[str]:
    found = []
    for line in headers.get_all("Cookie"):
        with contextlib.suppress(CookieError):
            jar = SimpleCookie(line)
            found += [jar[name].value] if name in jar else []
    return found


def _plain(status: http.HTTPStatus, text: str) -> Response:
    body = text.encode()
    headers = Headers({"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body)), **SAFE_HEADERS})
    return Response(status.value, status.phrase, headers, body)


def _hear_only(server: viser.ViserServer) -> None:
    """Drop every message that is not in HEARD, at the server and at each connection, before any handler sees it."""
    inner = server._websock_server
    for kind in list(inner._incoming_handlers):
        if kind not in HEARD:
            inner.unregister_handler(kind)
    _filter(inner)
    inner.on_client_connect(_filter)


def _filter(handler: viser.infra.WebsockMessageHandler) -> None:
    hear = handler._handle_incoming_message

    async def hear_some(client: Any, message: Any) -> None:
        if type(message) in HEARD:
            await hear(client, message)

    handler._handle_incoming_message = hear_some  # type: ignore[method-assign, assignment]
