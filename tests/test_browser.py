"""The browser that tests of pages look through: it must see what is wrong."""

from pathlib import Path

from helpers.browser import PHONE, Visitor

FINE = "<!doctype html><meta name=viewport content='width=device-width'><title>t</title><p>text</p>"


def page(folder: Path, body: str) -> Path:
    path = folder / "page.html"
    path.write_text(FINE + body)
    return path


def test_nothing_is_found_on_a_page_without_fault(visit: Visitor, tmp_path: Path) -> None:
    seen = visit(page(tmp_path, "<style>:root{color-scheme:light dark}</style>"), size=PHONE, scheme="dark")
    assert (seen.errors, seen.requests, seen.too_wide(), seen.poor_contrast()) == ([], [], [], [])


def test_errors_overflow_faint_text_and_requests_are_seen(visit: Visitor, tmp_path: Path) -> None:
    body = """<p style="color:#aaa">faint</p><div class="long" style="width:600px">wide</div><img src="gone.png">
    <meta http-equiv="Content-Security-Policy" content="script-src 'unsafe-inline'">
    <script>setTimeout(() => { try { eval("1") } catch {} throw new Error("thrown") })</script>"""
    seen = visit(page(tmp_path, body), size=PHONE)
    seen.page.wait_for_timeout(100)
    assert any("thrown" in error for error in seen.errors) and any("gone.png" in error for error in seen.errors)
    assert any("unsafe-eval" in error or "Security" in error for error in seen.errors)
    assert len(seen.requests) == 1 and seen.requests[0].endswith("gone.png")
    assert any("long" in found for found in seen.too_wide())
    assert ['"faint"' in found for found in seen.poor_contrast()] == [True]
