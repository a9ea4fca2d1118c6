"""A real Chromium for the tests of pages: the system's own, driven by Playwright.

`visit` opens a page in a window of a given size and colour scheme, and notes whatever goes wrong in it. The browser
lives as long as the module of tests: its event loop is this thread's, and tests of other modules want their own.
"""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
DESKTOP, PHONE = (1280, 900), (390, 844)  # CSS pixels

# Every visible piece of text whose colour stands out too little from what is painted behind it (WCAG 2.1, 1.4.3).
POOR_CONTRAST = """(least) => {
  const channel = (value) => (value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4);
  const pen = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
  const rgba = (colour) => {
    pen.clearRect(0, 0, 1, 1); pen.fillStyle = colour; pen.fillRect(0, 0, 1, 1);
    const [r, g, b, a] = pen.getImageData(0, 0, 1, 1).data; return [r, g, b, a / 255];
  };
  const over = (top, under) => top.slice(0, 3).map((c, i) => c * top[3] + under[i] * (1 - top[3])).concat(1);
  const light = ([r, g, b]) => 0.2126 * channel(r / 255) + 0.7152 * channel(g / 255) + 0.0722 * channel(b / 255);
  const behind = (element) => {
    const layers = [];
    for (let at = element; at; at = at.parentElement) layers.push(rgba(getComputedStyle(at).backgroundColor));
    return layers.reverse().reduce((under, top) => over(top, under), rgba(getComputedStyle(document.documentElement)
      .colorScheme.includes("dark") && matchMedia("(prefers-color-scheme: dark)").matches ? "#121212" : "#ffffff"));
  };
  const poor = new Set();
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const element = walker.currentNode.parentElement, text = walker.currentNode.textContent.trim();
    if (!text || /^(SCRIPT|STYLE|TEMPLATE)$/.test(element.tagName) || !element.checkVisibility()) continue;
    const style = getComputedStyle(element), paper = behind(element);
    const ink = over(rgba(element.closest("svg") ? style.fill : style.color), paper);
    const [a, b] = [light(ink), light(paper)].sort((x, y) => y - x);
    const ratio = (a + 0.05) / (b + 0.05);
    if (ratio < least) poor.add(`${ratio.toFixed(2)}: "${text.slice(0, 40)}" in <${element.tagName.toLowerCase()} `
      + `class="${element.getAttribute("class") ?? ""}">`);
  }
  return [...poor];
}"""

# Elements that reach beyond the window and do not lie in a box that scrolls by itself.
TOO_WIDE = """() => {
  const edge = document.documentElement.clientWidth;
  if (document.documentElement.scrollWidth <= edge) return [];
  const clips = (e) => /(auto|scroll|hidden|clip)/.test(getComputedStyle(e).overflowX);
  const scrolls = (e) => e && (clips(e) || scrolls(e.parentElement));
  const name = (e) => `<${e.tagName.toLowerCase()} class="${e.getAttribute("class") ?? ""}">`;
  return [...document.body.querySelectorAll("*")]
    .filter((e) => e.getBoundingClientRect().right > edge + 0.5 && !scrolls(e.parentElement))
    .map((e) => `${name(e)} to ${e.getBoundingClientRect().right}`)
    .concat([`the page is ${document.documentElement.scrollWidth} wide in a window of ${edge}`]);
}"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Visit:
    """An open page (Playwright's), what it complained about, and which addresses it asked for beyond its own file."""

    page: Any
    errors: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def too_wide(self) -> list[str]:
        """What makes the page wider than the window."""
        return self.page.evaluate(TOO_WIDE)

    def poor_contrast(self, least: float = 4.5) -> list[str]:
        """Visible texts whose contrast with what lies behind them is below `least`."""
        return self.page.evaluate(POOR_CONTRAST, least)


Visitor = Callable[..., Visit]


def find_chromium() -> str | None:
    """The system's Chromium."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """The running browser; skips where none is installed."""
    path = find_chromium()
    if path is None:
        pytest.skip(f"no Chromium on PATH ({', '.join(NAMES)}); `./ash-bench test` installs it where it may")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=list(FLAGS))
        yield browser
        browser.close()


@pytest.fixture
def visit(chromium: Any) -> Iterator[Visitor]:
    """Opens an address or a file, `visit(target, size=PHONE, scheme="dark")`; all are closed after the test."""
    contexts = []

    def open_page(
        target: str | Path,
        *,
        size: tuple[int, int] = DESKTOP,
        scheme: Literal["light", "dark"] = "light",
    ) -> Visit:
        viewport = {"width": size[0], "height": size[1]}
        context = chromium.new_context(viewport=viewport, color_scheme=scheme)
        contexts.append(context)
        found = Visit(page=context.new_page())
        found.page.on("console", lambda said: found.errors.append(said.text) if said.type == "error" else None)
        found.page.on("pageerror", lambda error: found.errors.append(str(error)))
        found.page.on("requestfailed", lambda request: found.errors.append(f"failed: {request.url[:200]}"))
        address = target.as_uri() if isinstance(target, Path) else target
        found.page.on("request", lambda request: _note(found.requests, request.url, address))
        found.page.goto(address, wait_until="load")
        return found

    yield open_page
    for context in contexts:
        context.close()


def _note(requests: list[str], url: str, own: str) -> None:
    if url != own and not url.startswith(("data:", "blob:")):
        requests.append(url)
