"""A viser server that only the person who started it can use.

viser by itself listens on every address, asks for no token, checks neither Host nor Origin, opens a public tunnel for
any client that asks, and accepts uploads. Here it listens on the loopback address; every request needs a random token
and an exact Host, every WebSocket an exact Origin too; three kinds of messages are handled, all others are dropped;
messages are small, and clients few. The hooks are viser's private ones: its version is pinned, and each is tested.
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

# Camera, sliders and buttons, and hot keys.
ALLOWED_MESSAGES = (
    messages.ViewerCameraMessage,
    messages.GuiUpdateMessage,
    messages.CommandTriggerMessage,
)
MAX_MESSAGE = 64 << 10  # bytes; a click is a few hundred
ANY_ADDRESS = ("0.0.0.0", "::")
SAFE_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": (
        "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; frame-ancestors 'none'; form-action 'none'"
    ),
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


@dataclass(frozen=True, kw_only=True, slots=True)
class AuthOptions:
    """Where the server listens, and who may connect."""

    host: str = "127.0.0.1"
    port: int = 0  # 0: a free one
    clients: int = 8
    allow_origins: tuple[str, ...] = ()  # such as http://localhost:9000, where a port is forwarded
    expose: bool = False  # listen beyond the loopback address


@dataclass(kw_only=True, slots=True)
class Auth:
    """The secrets of a running server, and how many clients are connected."""

    options: AuthOptions
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    # Cookies do not depend on the port, and another player may run on another.
    cookie: str = field(default_factory=lambda: f"ash_bench_{secrets.token_hex(4)}")
    origins: frozenset[str] = frozenset()
    connected: int = 0


def require_safe(options: AuthOptions) -> None:
    """Refuse to listen to other machines unless that was asked for, and malformed origins.

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
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


def open_server(options: AuthOptions, *, label: str) -> tuple[viser.ViserServer, str, Auth]:
    """Start a protected server; also the one address that opens it.

    Raises:
        InputError: the address is not safe or cannot be listened to.
    """
    require_safe(options)
    if options.port and not _is_free(options.host, options.port):
        raise InputError(f"port: {options.port} on {options.host} is taken; expected a free one (0: any)")
    auth = Auth(options=options)
    with _protected(auth), _silent():
        server = viser.ViserServer(host=options.host, port=options.port, label=label, verbose=False)
    port = server.get_port()
    auth.origins = frozenset({*_own_origins(options.host, port), *options.allow_origins})
    inner = server._websock_server
    _drop_other_messages(inner)
    inner.on_client_connect(_drop_other_messages)
    shown = "127.0.0.1" if options.host in ANY_ADDRESS else options.host
    return server, f"http://{_bracketed(shown)}:{port}/?token={auth.token}", auth


def close_server(server: viser.ViserServer) -> None:
    """Stop it and its threads."""
    with _silent():
        server.stop()


def _own_origins(host: str, port: int) -> set[str]:
    """What a browser calls this server."""
    names = {host}
    if _is_loopback(host) or host in ANY_ADDRESS:
        names |= {"127.0.0.1", "localhost", "::1"}
    if host in ANY_ADDRESS:
        addresses = [address for each in psutil.net_if_addrs().values() for address in each]
        names |= {a.address.partition("%")[0] for a in addresses if a.family in (socket.AF_INET, socket.AF_INET6)}
        names |= {socket.gethostname()}
    return {f"http://{_bracketed(name)}:{port}" for name in names}


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _is_free(host: str, port: int) -> bool:
    try:
        socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET).close()
    except OSError:
        return False
    return True


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """viser prints its addresses, which lack the token."""
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):  # noqa: PTH123
        yield


@contextlib.contextmanager
def _protected(auth: Auth) -> Iterator[None]:
    """A server that starts while the body runs checks its requests, limits its clients and their messages."""
    serve = websockets.asyncio.server.serve

    def guarded(handler: Callable[[Any], Awaitable[None]], *args: Any, **options: Any) -> Any:
        async def limited(connection: Any) -> None:
            if auth.connected >= auth.options.clients:
                await connection.close(1013, f"at most {auth.options.clients} viewers")
                return
            auth.connected += 1
            try:
                await handler(connection)
            finally:
                auth.connected -= 1

        page = options.pop("process_request")
        options["max_size"] = MAX_MESSAGE
        options["process_request"] = lambda connection, request: respond(auth, connection, request, page)
        return serve(limited, *args, **options)

    websockets.asyncio.server.serve = guarded  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]


def respond(auth: Auth, connection: Any, request: Request, page: Callable[[Any, Request], Any]) -> Response | None:
    """The response to a request: the page, None (a WebSocket may open), or the reason for neither."""
    reason = refusal(auth, request)
    if reason is not None:
        return _plain(http.HTTPStatus.FORBIDDEN, reason)
    if _is_websocket(request):
        return None
    url = urlsplit(request.path)
    if url.path != "/":
        return _plain(http.HTTPStatus.NOT_FOUND, "there is one page: /")
    if url.query:  # The token goes into a cookie and out of the address bar.
        response = _plain(http.HTTPStatus.SEE_OTHER, "")
        response.headers["Location"] = "/"
        response.headers["Set-Cookie"] = f"{auth.cookie}={auth.token}; HttpOnly; SameSite=Lax; Path=/"
        return response
    response = page(connection, request)
    for name, value in SAFE_HEADERS.items():
        response.headers[name] = value
    return response


def refusal(auth: Auth, request: Request) -> str | None:
    """Why a request is refused, None where it is not: Host, Origin and token are checked in this order."""
    headers = request.headers
    hosts = {urlsplit(origin).netloc for origin in auth.origins}
    if headers.get_all("Host") not in [[host] for host in hosts]:
        return "wrong Host: open the address that ash-bench play printed, or start it with --allow-origin"
    origins = headers.get_all("Origin")
    if (origins or _is_websocket(request)) and origins not in [[origin] for origin in auth.origins]:
        return "wrong Origin: start ash-bench play with --allow-origin if this address is yours"
    given = parse_qs(urlsplit(request.path).query).get("token", [])
    for line in headers.get_all("Cookie"):
        with contextlib.suppress(CookieError):
            jar = SimpleCookie(line)
            given += [jar[auth.cookie].value] if auth.cookie in jar else []
    if not any(secrets.compare_digest(token.encode(), auth.token.encode()) for token in given):
        return "wrong token: open the address that ash-bench play printed"
    return None


def _is_websocket(request: Request) -> bool:
    return any(value.strip().lower() == "websocket" for value in request.headers.get_all("Upgrade"))


def _plain(status: http.HTTPStatus, text: str) -> Response:
    headers = {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(text.encode())), **SAFE_HEADERS}
    return Response(status.value, status.phrase, Headers(headers), text.encode())


def _drop_other_messages(handler: viser.infra.WebsockMessageHandler) -> None:
    """Drop every message that is not allowed before any of viser's handlers sees it."""
    handle = handler._handle_incoming_message

    async def handle_allowed(client: Any, message: Any) -> None:
        if type(message) in ALLOWED_MESSAGES:
            await handle(client, message)

    handler._handle_incoming_message = handle_allowed  # type: ignore[method-assign, assignment]
