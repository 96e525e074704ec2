"""The built book in a browser: headless Chromium opens every page, at three widths."""

from __future__ import annotations

import html
import json
import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urldefrag, urlparse

import pytest

import browser
from access import find_violations
from browser import READY
from common import ROOT, chapters

BUILT = ROOT / "_build" / "html"
LOCAL = ("file://", "data:", "blob:", "about:")
# Pages that Chromium opens for itself: their requests do not belong to the book.
OWN = (
    "chrome://",
    "chrome-untrusted://",
    "chrome-extension://",
    "devtools://",
    "about:",
)
# Events of the log that stand for a request
ASKS = ("Network.requestWillBeSent", "Network.webSocketCreated")
WIDTHS = (1440, 1200, 400)
# A phone, a tablet, a desk
SIZES = (400, 800, 1440)
THEMES = ("light", "dark")
# Pages that together have every form; `make slow` takes all.
FORMS = (
    "index",
    "02b-counting-twice",
    "api/metrics",
    "which-filter",
    "reproductions",
)
# Opens folded parts, then reports raw markup, formulas that are not set and broken pictures.
# Raw markup is searched in visible text only: code may show it.
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
};
"""
# Elements that do not fit: they scroll in a box, are cut, or make the page too wide.
FIT = r"""
const whole = document.documentElement;
const out = {cut: [], scrolls: [], over: Math.max(0, whole.scrollWidth - whole.clientWidth)};
const parts = ".math mjx-math, pre, table, img, svg, .frames, .output";
for (const part of document.querySelectorAll("article :is(" + parts + ")")) {
  const box = part.getBoundingClientRect();
  if (box.width === 0) continue;
  const style = getComputedStyle(part).overflowX, formula = part.tagName === "MJX-MATH";
  const own = !formula && part.clientWidth > 0 && part.scrollWidth > part.clientWidth + 1;
  const words = (part.closest(".math") || part).textContent.trim().slice(0, 60);
  const name = part.tagName.toLowerCase() + ": " + words;
  if (own && (style === "auto" || style === "scroll")) { out.scrolls.push(name); continue; }
  if (own && (style === "hidden" || style === "clip")) { out.cut.push(name); continue; }
  const right = own ? box.left + part.scrollWidth : box.right;
  let where = right > window.innerWidth + 1 ? "cut" : "";
  for (let a = part.parentElement; a && a.tagName !== "BODY"; a = a.parentElement) {
    const held = getComputedStyle(a).overflowX, edge = a.getBoundingClientRect().right;
    if (held === "visible" || right <= edge + 1) continue;
    where = held === "auto" || held === "scroll" ? "scrolls" : "cut";
    break;
  }
  if (where) out[where].push(name);
}
return out;
"""
# Moves every slider by one step, then plays it: picture, alternative text and label must change.
MOVE = r"""
const done = arguments[arguments.length - 1], found = [];
const roots = [...document.querySelectorAll("[data-frames]")];
const wait = (ms) => new Promise(r => setTimeout(r, ms));
(async () => {
  for (const root of roots) {
    const [image, input] = [root.querySelector("img"), root.querySelector("input")];
    const [button, output] = [root.querySelector("button"), root.querySelector("output")];
    const now = () => [image.src, image.alt, output.textContent];
    const before = now(), last = Number(input.max);
    input.value = Number(input.value) === last ? 0 : Number(input.value) + 1;
    input.dispatchEvent(new Event("input"));
    const moved = now();
    button.click();
    for (let k = 0; k < 80 && now()[2] === moved[2]; k++) await wait(50);
    const played = now();
    button.click();
    await image.decode().catch(() => null);
    found.push({
      ready: root.hasAttribute("data-ready") && input.offsetWidth > 0,
      moved: moved.every((v, k) => v !== before[k]),
      played: played.every((v, k) => v !== moved[k]),
      drawn: image.naturalWidth > 0,
    });
  }
  done(found);
})();
"""


@dataclass
class Visit:
    """Observations of a browser on one page."""

    report: dict[str, Any]
    requests: list[str]
    console: list[str]
    fit: dict[int, dict[str, Any]]
    sliders: list[dict[str, bool]]


def set_width(driver: Any, width: int) -> None:
    """Set the width of the layout, whatever the window's own is."""
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)


def check_access(driver: Any, page: Path) -> dict[tuple[int, str], list[str]]:
    """Return the violations of rules of access, for each width and theme."""
    driver.get("about:blank")
    found = {}
    for width in SIZES:
        set_width(driver, width)
        # The page is loaded once, at the smallest width, where formulas scroll.
        if not found:
            driver.get(page.as_uri())
            driver.execute_async_script(READY)
        # Scripts of the page mark scrolling parts, 300 ms after a change.
        time.sleep(0.6)
        for theme in THEMES:
            found[width, theme] = find_violations(driver, theme)
    return found


def visit(driver: Any, page: Path) -> Visit:
    """Open a page at all widths, and collect reports, requests and errors."""
    # Leave the last page, which would be laid out again at each width.
    driver.get("about:blank")
    for kind in ("performance", "browser"):
        # Reading a log empties it: the last page's entries go.
        driver.get_log(kind)
    fit: dict[int, dict[str, Any]] = {}
    for width in WIDTHS:
        set_width(driver, width)
        # The page is loaded once, at the largest width.
        if not fit:
            driver.get(page.as_uri())
            driver.execute_async_script(READY)
            report = driver.execute_script(REPORT)
        fit[width] = driver.execute_script(FIT)
    # After the reports, since it changes the page.
    sliders = driver.execute_async_script(MOVE)
    entries = [json.loads(entry["message"]) for entry in driver.get_log("performance")]
    requests = requests_of(entries, driver.current_window_handle)
    console = [
        e["message"] for e in driver.get_log("browser") if e["level"] == "SEVERE"
    ]
    return Visit(report, requests, console, fit, sliders)


def requests_of(entries: list[dict[str, Any]], tab: str) -> list[str]:
    """Return the requests of the pages of one tab, from the browser's log.

    The log has the events of all tabs, also of those that Chromium opens for itself. A new tab
    first shows a page of Chromium.
    """
    # Entries without a tab belong to the one that is asked for.
    sent = [entry["message"] for entry in entries if entry.get("webview", tab) == tab]
    parameters = [message["params"] for message in sent if message["method"] in ASKS]
    urls = [params.get("request", params)["url"] for params in parameters]
    return [url for url in urls if not url.startswith(OWN)]


@contextmanager
def chromium(profile: Path, **logs: str) -> Iterator[Any]:
    """Yield a headless Chromium; without one the test is skipped, or fails in `CI`."""
    if browser.find_browser() is None:
        # A missing browser must not pass unnoticed where the tests are the gate.
        (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)(
            browser.NOT_INSTALLED
        )
    with browser.chromium(profile, **logs) as driver:
        yield driver


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Yield a browser that logs its requests and errors."""
    profile = tmp_path_factory.mktemp("profile")
    with chromium(profile, performance="ALL", browser="ALL") as browser_driver:
        # axe needs some seconds for a long page, more where other programs run.
        browser_driver.set_script_timeout(300)
        # The answer to a call must not be given up before the script is.
        browser_driver.command_executor.client_config.timeout = 330
        # The page behaves as if it had the focus, also in a headless browser.
        browser_driver.execute_cdp_cmd(
            "Emulation.setFocusEmulationEnabled", {"enabled": True}
        )
        yield browser_driver


def redirect(page: Path) -> Path | None:
    """Return the target of a page that only redirects, or None."""
    text = page.read_text(encoding="utf-8")
    sent = re.search(
        r'http-equiv="refresh" content="0; *url=([^"]+)"', text, flags=re.IGNORECASE
    )
    return (page.parent / sent.group(1)).resolve() if sent else None


def content_pages() -> list[Path]:
    """Return every page of the built book that is not a redirection."""
    # Files below _static are parts of packages, not pages.
    pages = sorted(p for p in BUILT.rglob("*.html") if "_static" not in p.parts)
    assert pages, "the book is not built: make book"
    return [page for page in pages if redirect(page) is None]


def pages_to_visit() -> list[Path]:
    """Return every page; of the pages with a module's source only the longest."""
    # These pages have one form; the longest is the hardest.
    listings = {page for page in content_pages() if "_modules" in page.parts}
    longest = max(listings, key=lambda page: page.stat().st_size)
    return [page for page in content_pages() if page not in listings - {longest}]


@pytest.fixture(scope="module")
def visits(driver: Any) -> dict[Path, Visit]:
    """Visit the pages."""
    return {page: visit(driver, page) for page in pages_to_visit()}


def broken_links(pages: list[Path]) -> list[str]:
    """Return the links to files or anchors that do not exist."""
    texts = {page: page.read_text(encoding="utf-8") for page in pages}
    # An anchor is an id, or a name in older HTML.
    anchors = {
        page: set(re.findall(r'\s(?:id|name)="([^"]+)"', text))
        for page, text in texts.items()
    }
    broken = []
    for page, text in texts.items():
        for link in set(re.findall(r'<a\s[^>]*?href="([^"]*)"', text)):
            url, anchor = urldefrag(unquote(html.unescape(link)))
            target = Path(os.path.normpath(page.parent / url)) if url else page
            # Links to other sites are not followed: the tests need no network.
            if not urlparse(url).scheme and (
                not target.is_file()
                or (anchor and anchor not in anchors.get(target, {anchor}))
            ):
                broken.append(f"{page.name} -> {link}")
    return broken


def outside(page_visit: Visit) -> list[str]:
    """Return the requests that leave the machine."""
    return [url for url in page_visit.requests if not url.startswith(LOCAL)]


def test_no_request_leaves_the_machine(visits: dict[Path, Visit]) -> None:
    # The first page is reached from the top, and every page asks for something: the log
    # works.
    assert redirect(BUILT / "index.html") == BUILT / "book" / "index.html"
    assert all(page_visit.requests for page_visit in visits.values())
    # Fonts, MathJax and pictures all come from the book's own folder.
    assert {
        p.name: outside(page_visit)
        for p, page_visit in visits.items()
        if outside(page_visit)
    } == {}


def test_console_has_no_error(visits: dict[Path, Visit]) -> None:
    # A script that fails writes an error to the console.
    assert {
        p.name: page_visit.console
        for p, page_visit in visits.items()
        if page_visit.console
    } == {}


@pytest.mark.parametrize("key", ["raw", "unset", "merror", "flat", "broken", "mute"])
def test_mathematics_and_figures_are_shown(visits: dict[Path, Visit], key: str) -> None:
    # Each key lists the faults of one kind, see REPORT.
    assert {
        page.name: v.report[key] for page, v in visits.items() if v.report[key]
    } == {}


def test_no_link_is_broken() -> None:
    assert broken_links(content_pages()) == []


def test_every_page_fits_and_on_a_desk_scrolls_in_no_box(
    visits: dict[Path, Visit],
) -> None:
    for page, page_visit in visits.items():
        for width, fit in page_visit.fit.items():
            # On a phone wide code may scroll in its box; on a desk nothing has to.
            assert fit["over"] == 0 and fit["cut"] == [], f"{page.name} at {width}"
            assert width < 1200 or fit["scrolls"] == [], f"{page.name} at {width}"


@pytest.mark.parametrize("name", FORMS)
def test_a_page_of_each_form_is_accessible(driver: Any, name: str) -> None:
    violations = check_access(driver, BUILT / "book" / f"{name}.html")
    assert {where: found for where, found in violations.items() if found} == {}


@pytest.mark.slow
def test_every_page_is_accessible(driver: Any) -> None:
    violations = {}
    for page in pages_to_visit():
        for where, found in check_access(driver, page).items():
            if found:
                violations[page.name, where] = found
    assert violations == {}


def test_every_slider_moves_and_plays(visits: dict[Path, Visit]) -> None:
    for source in chapters():
        # As many sliders as the source draws, and each of them ready, moved, played and
        # drawn
        drawn = source.read_text(encoding="utf-8").count("plotting.slider(")
        moved = visits[BUILT / "book" / f"{source.stem}.html"].sliders
        assert len(moved) == drawn and all(all(s.values()) for s in moved), (
            source.stem,
            moved,
        )


BAD = r"""<!doctype html><title>bad</title><body>
<p>\(x\)</p><p class="math">x</p><img src="nowhere.png">
<a href="nowhere.html">a</a><a href="#no">b</a>
<img src="http://example.invalid/a.png" alt="far"><div style="width: 2000px">wide</div>
<article><div style="width: 300px; overflow: hidden">
<pre>x<span style="padding: 400px">x</span></pre></div>
<pre style="overflow-x: auto; width: 300px">x<span style="padding: 400px">x</span></pre></article>
<div data-frames="a"><img alt="a"><button></button><input type="range" max="3">
<output>a</output></div>
<table><th></th></table><script>throw new Error("broken")</script></body>"""


def test_every_fault_of_a_bad_page_is_reported(driver: Any, tmp_path: Path) -> None:
    page = tmp_path / "bad.html"
    page.write_text(BAD, encoding="utf-8")
    page_visit = visit(driver, page)
    assert page_visit.report["raw"]
    assert page_visit.report["unset"]
    assert page_visit.report["mute"]
    # A test of the tests: each of the page's faults must be in exactly one report.
    assert len(page_visit.report["broken"]) == 3
    assert len(broken_links([page])) == 2
    assert outside(page_visit)
    assert page_visit.console
    assert (
        # One listing is cut by its box, the other one scrolls.
        len(page_visit.fit[1200]["cut"]) == 1
        and len(page_visit.fit[1200]["scrolls"]) == 1
    )
    assert page_visit.sliders
    assert not any(page_visit.sliders[0].values())
    assert page_visit.fit[400]["over"] > 0


FAULTS = r"""<!doctype html><body style="background: #fff">
<style>.flat:focus-visible { outline: none; } pre { overflow-x: auto; width: 9em; }
html[data-theme=dark] .dark { color: #ddd; }</style>
<main><article><h1>Faults</h1><h3>skipped</h3><img src="data:,"><button></button>
<a href="#a" aria-label="one">two</a><a href="#b" class="flat">flat</a>
<table><tr><td>a</td></tr></table><table><tr><th></th><td>a</td></tr></table>
<dl><dd>a</dd></dl><div role="img" aria-label="map"><a href="#c">c</a></div>
<p style="color: #bbb">faint</p><p class="dark">faint in the dark</p>
<pre>a line that is longer than its box, which the keyboard does not reach</pre>
</article></main><main>second</main><p>outside</p></body>"""
FOUND = {
    "html-has-lang",
    "document-title",
    "heading-order",
    "image-alt",
    "button-name",
    "label-content-name-mismatch",
    "focus is not seen",
    "table without headers",
    "empty-table-header",
    "definitions without a term",
    "nested-interactive",
    "color-contrast",
    "scrollable-region-focusable",
    "landmark-no-duplicate-main",
    "region",
}


def test_every_fault_of_access_is_found(driver: Any, tmp_path: Path) -> None:
    page = tmp_path / "faults.html"
    page.write_text(FAULTS, encoding="utf-8")
    violations = check_access(driver, page)
    assert set(violations) == {(width, theme) for width in SIZES for theme in THEMES}
    for (_, theme), found in violations.items():
        assert {violation.partition(":")[0] for violation in found} >= FOUND
        # Contrast is that of the theme.
        assert any("in the dark" in violation for violation in found) == (
            theme == "dark"
        )
