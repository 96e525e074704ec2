"""The built book in a browser: headless Chromium opens every page, wide and 400 px narrow."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urldefrag, urlparse

import pytest

from common import toc_pages

ROOT = Path(__file__).resolve().parents[2]
BUILT = ROOT / "_build" / "html"
# The last is the start page, which Chromium carries in itself.
LOCAL = ("file://", "data:", "blob:", "about:", "chrome://")
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--no-default-browser-check",
)

# Waits for the mathematics, opens what is folded, then reports what a reader would meet.
READY = """
const done = arguments[arguments.length - 1];
const ready = window.MathJax && MathJax.startup ? MathJax.startup.promise : Promise.resolve();
const pictures = [...document.images].map(i => i.decode().catch(() => null));
ready.then(() => Promise.all(pictures)).then(() => done(true));
"""
REPORT = r"""
document.querySelectorAll("details").forEach(d => { d.open = true; });
const raw = [];
const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
while (texts.nextNode()) {
  const node = texts.currentNode, parent = node.parentElement;
  if (parent.closest("code, pre, script, style, mjx-container, textarea, noscript")) continue;
  if (/\\\(|\\\[|\$\$|\\begin\{|\$[^$\s][^$]*\$|\{(eq|ref|numref|cite|doc)\w*\}`/
      .test(node.data)) raw.push(node.data.trim().slice(0, 80));
}
const name = e => (e.getAttribute("src") || "").slice(0, 80);
return {
  raw: raw,
  unset: [...document.querySelectorAll(".math")]
    .filter(e => !e.querySelector("mjx-container") && !e.closest("mjx-container"))
    .map(e => e.textContent.slice(0, 80)),
  merror: [...document.querySelectorAll("mjx-merror, [data-mml-node=merror]")]
    .map(e => e.textContent.slice(0, 80)),
  flat: [...document.querySelectorAll(".math mjx-container")]
    .filter(e => e.getBoundingClientRect().width < 1).length,
  broken: [...document.images].filter(i => !i.complete || i.naturalWidth === 0).map(name),
  mute: [...document.images].filter(i => !(i.getAttribute("alt") || "").trim()).map(name),
  links: [...document.querySelectorAll("a[href]")].map(a => a.href),
  ids: [...document.querySelectorAll("[id], a[name]")].map(e => e.id || e.name),
  formulas: document.querySelectorAll(".math").length,
};
"""
WIDTHS = "return [document.documentElement.scrollWidth, document.documentElement.clientWidth];"


@dataclass
class Visit:
    """What a browser met on one page."""

    report: dict[str, Any]
    requests: list[str]
    console: list[str]
    widths: dict[int, tuple[int, int]] = field(default_factory=dict)


def visit(driver: Any, page: Path) -> Visit:
    """Open a page, wide and narrow, and collect what happened."""
    for kind in ("performance", "browser"):
        driver.get_log(kind)
    widths = {}
    for width in (1280, 400):
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        driver.get(page.as_uri())
        driver.execute_async_script(READY)
        report = driver.execute_script(REPORT)
        scroll, client = driver.execute_script(WIDTHS)
        widths[width] = (scroll, client)
    requests = []
    for entry in driver.get_log("performance"):
        message = json.loads(entry["message"])["message"]
        if message["method"] == "Network.requestWillBeSent":
            requests.append(message["params"]["request"]["url"])
        elif message["method"] == "Network.webSocketCreated":
            requests.append(message["params"]["url"])
    console = [e["message"] for e in driver.get_log("browser") if e["level"] == "SEVERE"]
    return Visit(report, requests, console, widths)


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Yield a headless Chromium with a fresh profile."""
    browser, helper = shutil.which("chromium"), shutil.which("chromedriver")
    if not browser or not helper:
        message = "chromium or chromedriver is not installed: no page was opened in a browser"
        if os.environ.get("CI") == "true":
            pytest.fail(message)
        pytest.skip(message)
    from selenium import webdriver
    from selenium.webdriver.chrome.options import Options
    from selenium.webdriver.chrome.service import Service

    options = Options()
    options.binary_location = browser
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"performance": "ALL", "browser": "ALL"})
    chromium = webdriver.Chrome(options=options, service=Service(helper))
    chromium.set_script_timeout(60)
    yield chromium
    chromium.quit()


def redirect(page: Path) -> Path | None:
    """Return the page that another one only sends its reader on to."""
    text = page.read_text(encoding="utf-8")
    sent = re.search(r'http-equiv="refresh" content="0; *url=([^"]+)"', text, flags=re.IGNORECASE)
    return (page.parent / sent.group(1)).resolve() if sent else None


@pytest.fixture(scope="module")
def visits(driver: Any) -> dict[Path, Visit]:
    """Return what the browser met on each built page."""
    pages = sorted(p for p in BUILT.rglob("*.html") if "_static" not in p.parts)
    assert pages, "the book is not built: make book"
    return {page: visit(driver, page) for page in pages if redirect(page) is None}


def found(visits: dict[Path, Visit], key: str) -> dict[str, Any]:
    """Return the pages whose report has something under the key."""
    return {page.name: v.report[key] for page, v in visits.items() if v.report[key]}


def broken_links(visits: dict[Path, Visit]) -> list[str]:
    """Return the links to files or anchors that are not there."""
    out = []
    for page, seen in visits.items():
        for link in seen.report["links"]:
            if urlparse(link).scheme != "file":
                continue
            url, anchor = urldefrag(link)
            target = Path(unquote(urlparse(url).path))
            known = visits[target].report["ids"] if target in visits else None
            lost = anchor and known is not None and unquote(anchor) not in known
            if not target.is_file() or lost:
                out.append(f"{page.name} -> {link}")
    return out


def outside(seen: Visit) -> list[str]:
    """Return the requests that leave the machine."""
    return [url for url in seen.requests if not url.startswith(LOCAL)]


def test_every_page_of_the_contents_is_there(visits: dict[Path, Visit]) -> None:
    names = {page.relative_to(BUILT).with_suffix("").as_posix() for page in visits}
    assert set(toc_pages()) <= names
    assert redirect(BUILT / "index.html") == BUILT / "book" / "index.html"


def test_no_request_leaves_the_machine(visits: dict[Path, Visit]) -> None:
    assert all(seen.requests for seen in visits.values())
    assert {p.name: outside(seen) for p, seen in visits.items() if outside(seen)} == {}


def test_console_has_no_error(visits: dict[Path, Visit]) -> None:
    assert {p.name: seen.console for p, seen in visits.items() if seen.console} == {}


def test_mathematics_is_rendered(visits: dict[Path, Visit]) -> None:
    for key in ("raw", "unset", "merror", "flat"):
        assert found(visits, key) == {}, key


def test_no_link_is_broken(visits: dict[Path, Visit]) -> None:
    assert broken_links(visits) == []


def test_no_figure_is_missing_or_mute(visits: dict[Path, Visit]) -> None:
    for key in ("broken", "mute"):
        assert found(visits, key) == {}, key


def test_nothing_scrolls_sideways(visits: dict[Path, Visit]) -> None:
    wide = {
        (page.name, width): f"{scroll} px of {client}"
        for page, seen in visits.items()
        for width, (scroll, client) in seen.widths.items()
        if scroll > client
    }
    assert wide == {}


BAD = r"""<!doctype html><title>bad</title><body>
<p>\(x\)</p><p class="math">x</p><img src="nowhere.png">
<a href="nowhere.html">a</a><a href="#no">b</a>
<img src="http://example.invalid/a.png" alt="far"><div style="width: 2000px">wide</div>
<script>throw new Error("broken")</script></body>"""


def test_a_bad_page_is_found_out(driver: Any, tmp_path: Path) -> None:
    page = tmp_path / "bad.html"
    page.write_text(BAD, encoding="utf-8")
    seen = visit(driver, page)
    assert seen.report["raw"] and seen.report["unset"] and seen.report["mute"]
    assert len(seen.report["broken"]) == 2
    assert len(broken_links({page: seen})) == 2
    assert outside(seen) and seen.console
    assert seen.widths[400][0] > seen.widths[400][1]
