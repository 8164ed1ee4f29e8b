"""A page opened in Chromium without a screen, offline, and what it complains about."""

import os
import shutil
from contextlib import contextmanager
from pathlib import Path

import pytest

FLAGS = [
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


def chromium():
    found = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
    if not found:
        pytest.skip("chromium is not installed (apt-get install chromium), so the page cannot be opened in a browser")
    return found


@contextmanager
def opened(page: Path, *, width=1280, height=900, dark=False):
    """The page, and the list of complaints that grows while it is used."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed (development group)")
    executable = chromium()
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=executable, args=FLAGS, chromium_sandbox=False)
        try:
            context = browser.new_context(
                viewport={"width": width, "height": height},
                color_scheme="dark" if dark else "light",
                java_script_enabled=True,
            )
            complaints = []
            context.on("request", lambda request: _note_request(request, page, complaints))
            shown = context.new_page()
            shown.on("console", lambda message: complaints.append(f"console {message.type}: {message.text}"))
            shown.on("pageerror", lambda error: complaints.append(f"error: {error}"))
            shown.goto(page.as_uri(), wait_until="load")
            yield shown, complaints
        finally:
            browser.close()


def hindrances(page: Path):
    """What axe finds that keeps some people from reading or using a page: narrow and wide, light and dark."""
    axe = pytest.importorskip(
        "axe_playwright_python.sync_playwright", reason="axe is not installed (development group)"
    )
    found = []
    for width, dark in ((360, False), (800, True), (1400, False)):
        with opened(page, width=width, dark=dark) as (shown, complaints):
            for rule in axe.Axe().run(shown).response["violations"]:
                found += [f"{width} px, {rule['id']}: {rule['help']}: {each['html'][:200]}" for each in rule["nodes"]]
            found += complaints
    return found


def _note_request(request, page, complaints):
    if not request.url.startswith(("data:", page.as_uri())):
        complaints.append(f"request: {request.url[:200]}")


def until(page, condition, seconds=60):
    """Wait for a condition; the page's own security policy keeps Playwright from polling it inside the page."""
    for _ in range(10 * seconds):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(100)
    raise AssertionError(f"not within {seconds} s: {condition}")
