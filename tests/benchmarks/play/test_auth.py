"""The player's server: which requests and messages it accepts, and that it refuses all others."""

import contextlib
import http.client
import math
import threading
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
import viser
import viser._messages as messages
from helpers.viewers import FakeBrowser, address_of, browsers, cookie_of, enter, get, message
from helpers.waiting import wait_for
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from ash.files import InputError
from benchmarks import cli
from benchmarks.play.auth import ALLOWED_MESSAGES, Auth, AuthOptions, close_server, open_server, require_safe

Served = tuple[viser.ViserServer, str, Auth]


@contextlib.contextmanager
def running(**options: object) -> Iterator[Served]:
    """A server without content, its address, and who may connect."""
    server, url, auth = open_server(AuthOptions(**options), label="auth")  # type: ignore[arg-type]
    yield server, url, auth
    close_server(server)


@pytest.fixture()
def served() -> Iterator[Served]:
    """A server for one test."""
    with running(clients=3) as server:
        yield server


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    """The address of a server that tests share."""
    with running(clients=3, allow_origins=("http://my.host:9000",)) as (_, url, _):
        yield url


def port_of(url: str) -> int:
    return int(address_of(url).rpartition(":")[2])


def listening(port: int) -> set[str]:
    """The addresses on which this process listens at a port, by the kernel's own table."""
    sockets = psutil.Process().net_connections("inet")
    return {each.laddr.ip for each in sockets if each.laddr.port == port and not each.raddr}


def test_it_listens_on_the_loopback_address_alone(url: str) -> None:
    assert listening(port_of(url)) == {"127.0.0.1"}
    with running(host="0.0.0.0", expose=True) as (_, exposed, _):  # The same check sees one that listens everywhere.
        assert listening(port_of(exposed)) == {"0.0.0.0"}


def test_the_printed_address_opens_the_page_and_the_token_leaves_the_address_bar(url: str) -> None:
    address = address_of(url)
    status, headers, _ = get(url, url.partition(address)[2], Host=address)
    assert status == 303 and headers["Location"] == "/"
    assert "HttpOnly" in headers["Set-Cookie"] and "SameSite=Lax" in headers["Set-Cookie"]
    status, headers, content = get(url, "/", Host=address, Cookie=cookie_of(url))
    assert status == 200 and b"<html" in content[:500].lower()
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"] and headers["Cache-Control"] == "no-store"


@pytest.mark.parametrize("path", ["/", "/?token=", "/?token=wrong", "/?token=%00", "/index.html"])
def test_a_wrong_token_is_refused(url: str, path: str) -> None:
    for cookie in ("", "ash_bench=1", cookie_of(url)[:-1], cookie_of(url).partition("=")[0] + "=x"):
        status, _, content = get(url, path, Host=address_of(url), **({"Cookie": cookie} if cookie else {}))
        assert status == 403 and b"wrong token" in content


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1", "localhost:1", "evil.example:{port}", "[::1]", ""])
def test_a_wrong_host_is_refused_whatever_the_token(url: str, host: str) -> None:
    status, _, content = get(url, "/", Host=host.format(port=port_of(url)), Cookie=cookie_of(url))
    assert status == 403 and b"wrong Host" in content


def test_two_hosts_are_refused(url: str) -> None:
    with contextlib.closing(http.client.HTTPConnection(address_of(url), timeout=10)) as connection:
        connection.putrequest("GET", "/", skip_host=True)
        for name, value in (("Host", address_of(url)), ("Host", "evil.example"), ("Cookie", cookie_of(url))):
            connection.putheader(name, value)
        connection.endheaders()
        with connection.getresponse() as response:
            assert response.status in (400, 403)


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "https://{address}", "http://{address}.evil.example"]
)
def test_a_websocket_from_a_wrong_origin_is_refused(url: str, origin: str) -> None:
    with pytest.raises(InvalidStatus) as refused:
        enter(url, origin=origin.format(address=address_of(url)))
    assert refused.value.response.status_code == 403 and b"wrong Origin" in refused.value.response.body


def test_a_websocket_without_origin_or_token_is_refused(url: str) -> None:
    with pytest.raises(InvalidStatus, match="403"):
        connect(f"ws://{address_of(url)}", additional_headers={"Cookie": cookie_of(url)}, compression=None)
    with pytest.raises(InvalidStatus) as refused:
        enter(url, cookie="nothing=1")
    assert refused.value.response.status_code == 403 and b"wrong token" in refused.value.response.body


def test_an_allowed_origin_of_a_forwarded_port_may_connect(url: str) -> None:
    assert get(url, "/", Host="my.host:9000", Cookie=cookie_of(url))[0] == 200
    enter(url, origin="http://my.host:9000").close()


@pytest.mark.parametrize("path", ["/index.html", "/etc/passwd", "/../../x", "/%2e%2e/%2e%2e/etc/passwd", "//"])
def test_there_is_one_page_and_no_path(url: str, path: str) -> None:
    status, _, content = get(url, path, Host=address_of(url), Cookie=cookie_of(url))
    assert status == 404 and content == b"there is one page: /"


def test_messages_that_are_not_allowed_reach_no_handler(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """No public tunnel, no upload, nothing but camera, controls and keys."""
    server, url, _ = served
    called: list[str] = []
    monkeypatch.setattr(server, "request_share_url", lambda *_, **__: called.append("share"))
    monkeypatch.setattr(server, "disconnect_share_url", lambda *_, **__: called.append("end"))
    others = [kind for kind in messages.Message.get_subclasses() if kind not in ALLOWED_MESSAGES]
    assert len(others) > 80 and len(ALLOWED_MESSAGES) == 3
    for kind in (messages.LocalStorageGetItemResponseMessage, messages.GetRenderResponseMessage):
        server._websock_server.register_handler(kind, lambda _, m: called.append(type(m).__name__))
    upload = server.gui.add_upload_button("upload")._impl.uuid
    with browsers(url, 1) as (browser,):
        for _ in range(2):  # Replayed, too.
            browser.send("ShareUrlRequest")
            browser.send("ShareUrlDisconnect")
        browser.send(
            "FileTransferStartUpload", source_component_uuid=upload, transfer_uuid="a", filename="x",
            mime_type="text/plain", part_count=1, size_bytes=1,
        )  # fmt: skip
        browser.send("FileTransferPart", source_component_uuid=upload, transfer_uuid="a", part_index=0, content=b"x")
        browser.send("LocalStorageGetItemResponseMessage", value="x", error=None, request_uuid="x")
        browser.send("GetRenderResponseMessage", payload=b"x", render_uuid="x")
        _wait_until_handled(server, browser)
    assert called == [] and server._share_tunnel is None and server.gui._current_file_upload_states == {}


def test_large_and_broken_messages_end_their_connection_and_nothing_else(served: Served) -> None:
    server, url, auth = served
    with browsers(url, 1) as (browser,):
        for bad in (b"\xff" * 100, b"", message("NoSuchMessage"), message("ViewerCameraMessage"), b"\x90" * 70_000):
            with enter(url) as other:
                other.send(bad)
                with pytest.raises(ConnectionClosed):
                    for _ in range(200):
                        other.recv(timeout=10)
        wait_for(lambda: auth.connected == 1)
        _wait_until_handled(server, browser)


def test_so_many_viewers_and_no_more(served: Served) -> None:
    _, url, auth = served
    with browsers(url, 3):
        wait_for(lambda: auth.connected == 3)
        with enter(url) as fourth, pytest.raises(ConnectionClosed, match="at most 3 viewers"):
            fourth.recv(timeout=10)
    wait_for(lambda: auth.connected == 0)
    enter(url).close()


def test_simultaneous_connections_stay_below_the_limit(served: Served) -> None:
    _, url, auth = served
    cookie, sockets, counts = cookie_of(url), [], []

    def open_one() -> None:
        with contextlib.suppress(InvalidStatus, ConnectionClosed, TimeoutError, EOFError):
            sockets.append(enter(url, cookie=cookie))
        counts.append(auth.connected)

    threads = [threading.Thread(target=open_one) for _ in range(16)]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    assert max(counts) == 3 and auth.connected <= 3
    for each in sockets:
        each.close()


def test_other_machines_may_connect_only_when_that_is_asked_for(tmp_path: Path, capsys) -> None:
    for host in ("0.0.0.0", "::", "192.168.1.5", "my.host"):
        with pytest.raises(InputError, match="--expose"):
            require_safe(AuthOptions(host=host))
        require_safe(AuthOptions(host=host, expose=True))
    for host in ("127.0.0.1", "localhost", "::1", "127.0.0.2"):
        require_safe(AuthOptions(host=host))
    assert cli.main(["play", str(tmp_path), "--host", "0.0.0.0"]) == cli.WRONG_INPUT
    assert "nothing is encrypted" in capsys.readouterr().err
    for origin in ("localhost:9000", "http://", "ftp://x:1", "http://x:1/", "http://x:1/path"):
        with pytest.raises(InputError, match="http://HOST:PORT"):
            require_safe(AuthOptions(allow_origins=(origin,)))


def test_a_port_in_use_is_refused_and_not_replaced(url: str) -> None:
    with pytest.raises(InputError, match=f"port: {port_of(url)}"):
        open_server(AuthOptions(port=port_of(url)), label="auth")


def test_tokens_are_long_and_differ(url: str, served: Served) -> None:
    _, other, auth = served
    assert url.partition("token=")[2] != other.partition("token=")[2] and len(auth.token) >= 32


def _wait_until_handled(server: viser.ViserServer, browser: FakeBrowser) -> None:
    """Until everything that was sent before is handled: messages of one connection are handled in order."""
    wait_for(lambda: len(server.get_clients()) == 1)
    (client,) = server.get_clients().values()
    browser.angle += 0.5
    browser.look(browser.angle)
    wait_for(lambda: abs(float(client.camera.position[0]) - 2.5 * math.sin(browser.angle)) < 1e-6)
