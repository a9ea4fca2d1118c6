"""Browsers of the player that are none: they speak viser's protocol and count pictures."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.client import HTTPConnection
from urllib.parse import urlsplit

import msgspec
import numpy as np
import viser
import zstandard
from helpers.waiting import wait_for
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from benchmarks.play.player import PlayServer
from benchmarks.play.rendering import ViewState

PATIENCE = 120.0  # seconds; software graphics on a busy machine


def state_of(player: PlayServer) -> ViewState:
    """What the only viewer looks at, once the one before has left."""
    wait_for(lambda: len(player.pages) == 1, PATIENCE)
    (page,) = player.pages.values()
    return page.viewer.state


def address_of(url: str) -> str:
    """HOST:PORT of the player's address."""
    return urlsplit(url).netloc


def get(url: str, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    """One request with exactly these headers; status, headers and content of the answer."""
    parts = urlsplit(url)
    connection = HTTPConnection(parts.hostname, parts.port, timeout=10)
    try:
        connection.putrequest("GET", path, skip_host=True, skip_accept_encoding=True)
        for name, value in headers.items():
            connection.putheader(name, value)
        connection.endheaders()
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()
    finally:
        connection.close()


def cookie_of(url: str) -> str:
    """The cookie that the printed address gives."""
    parts = urlsplit(url)
    status, headers, _ = get(url, f"/?{parts.query}", Host=parts.netloc)
    assert status == 303, status
    return headers["Set-Cookie"].partition(";")[0]


def enter(url: str, *, origin: str | None = None, cookie: str | None = None) -> ClientConnection:
    """A WebSocket, as the page opens one. Raises what websockets raises where it is refused."""
    address = address_of(url)
    return connect(
        f"ws://{address}",
        origin=origin or f"http://{address}",  # type: ignore[arg-type]
        additional_headers={"Cookie": cookie_of(url) if cookie is None else cookie},
        subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
        compression=None,
        max_size=None,
        open_timeout=20,
    )


def message(kind: str, **content: object) -> bytes:
    """A message to the server."""
    return msgspec.msgpack.encode({"type": kind, **content})


def messages_in(packet: bytes) -> list[dict]:
    """The messages that one packet from the server holds, without their arrays."""
    size = int.from_bytes(packet[8:16], "little")
    inner = zstandard.ZstdDecompressor().decompress(packet[16 : 16 + size])
    return list(msgspec.msgpack.decode(inner)["messages"])


@dataclass
class FakeBrowser:
    """One viewer who turns around the person."""

    url: str
    width: int = 512
    height: int = 512
    arrivals: list[float] = field(default_factory=list)  # of pictures, perf_counter
    controls: dict[str, str] = field(default_factory=dict)  # label -> uuid
    texts: dict[str, str] = field(default_factory=dict)  # uuid -> Markdown
    commands: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.socket = enter(self.url)
        self.angle = 0.3
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()
        self.look(self.angle)

    def _listen(self) -> None:
        from websockets.exceptions import ConnectionClosed

        try:
            while True:
                packet = self.socket.recv()
                now = time.perf_counter()
                for each in messages_in(packet):
                    self._note(each, now)
        except (ConnectionClosed, OSError, EOFError):
            pass

    def _note(self, each: dict, now: float) -> None:
        if each["type"] == "BackgroundImageMessage" and each["rgb_data"] is not None:
            self.arrivals.append(now)
        elif each["type"] == "RegisterCommandMessage":
            self.commands[each["props"]["label"]] = each["uuid"]
        elif "props" in each and isinstance(each["props"], dict):
            if label := each["props"].get("label"):
                self.controls[label] = each["uuid"]
            if "_markdown" in each["props"]:
                self.texts[each["uuid"]] = each["props"]["_markdown"]
        elif each["type"] == "GuiUpdateMessage" and "_markdown" in each["updates"]:
            self.texts[each["uuid"]] = each["updates"]["_markdown"]

    @property
    def words(self) -> str:
        """All that the page says."""
        return "\n".join(self.texts.values())

    def look(self, angle: float) -> None:
        """Stand at an angle about the person, and say so."""
        position = np.array([2.5 * np.sin(angle), 1.2, 2.5 * np.cos(angle)])
        target = np.array([0.0, 0.9, 0.0])
        forward = (target - position) / np.linalg.norm(target - position)
        right = np.cross(forward, [0, 1.0, 0])
        right /= np.linalg.norm(right)
        from scipy.spatial.transform import Rotation

        x, y, z, w = Rotation.from_matrix(np.stack([right, np.cross(forward, right), forward], axis=1)).as_quat()
        self.send(
            "ViewerCameraMessage",
            wxyz=[float(w), float(x), float(y), float(z)],
            position=position.tolist(),
            fov=0.8,
            near=0.01,
            far=1000.0,
            image_height=self.height,
            image_width=self.width,
            look_at=target.tolist(),
            up_direction=[0.0, 1.0, 0.0],
        )

    def send(self, kind: str, **content: object) -> None:
        """Any message."""
        self.socket.send(message(kind, **content))

    def set(self, label: str, value: object) -> None:
        """Turn a control."""
        self.send("GuiUpdateMessage", uuid=self.controls[label], updates={"value": value})

    def press(self, command: str) -> None:
        """A hot key, by what it does."""
        self.send("CommandTriggerMessage", uuid=self.commands[command])

    def turn(self, seconds: float, *, per_second: float = 40.0) -> None:
        """Turn about the person for a while, as a mouse would."""
        end = time.perf_counter() + seconds
        while time.perf_counter() < end:
            self.angle += 0.02
            self.look(self.angle)
            time.sleep(1 / per_second)

    def wait_for(self, what, seconds: float = 20.0) -> None:
        """Until something is so."""
        wait_for(what, seconds, about=lambda: f"; the page says: {self.words}")

    def close(self) -> None:
        """Leave."""
        self.socket.close()
        self._thread.join(5)


@contextmanager
def browsers(url: str, count: int, **options: int) -> Iterator[list[FakeBrowser]]:
    """Several viewers at once."""
    opened: list[FakeBrowser] = []
    try:
        for _ in range(count):
            opened.append(FakeBrowser(url, **options))
        yield opened
    finally:
        for browser in opened:
            browser.close()
