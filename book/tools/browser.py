"""A headless Chromium, which sets formulas and prints pages."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

# A container has no user namespace for the sandbox and little shared memory; the
# browser must ask for nothing by itself.
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
)
READY = """
const done = arguments[arguments.length - 1];
const ready = window.MathJax && MathJax.startup ? MathJax.startup.promise : Promise.resolve();
const pictures = [...document.images].map(i => i.decode().catch(() => null));
ready.then(() => Promise.all(pictures)).then(() => done(true));
"""
"""Waits until formulas and pictures of a page are there."""

NOT_INSTALLED = "chromium or chromedriver is not installed"


def find_browser() -> tuple[str, str] | None:
    """Return the paths of a browser and of its driver, or None."""
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    browser = next(filter(None, map(shutil.which, names)), None)
    driver = shutil.which("chromedriver")
    return (browser, driver) if browser and driver else None


@contextmanager
def chromium(profile: Path, **logs: str) -> Iterator[Any]:
    """Yield a browser with a new profile and the given logs."""
    paths = find_browser()
    if paths is None:
        raise FileNotFoundError(NOT_INSTALLED)
    from selenium import webdriver
    from selenium.webdriver.chrome.options import Options
    from selenium.webdriver.chrome.service import Service

    # A profile of its own: a running browser would lock a common one.
    options = Options()
    options.binary_location = paths[0]
    for flag in (*FLAGS, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", logs)
    driver = webdriver.Chrome(options=options, service=Service(paths[1]))
    try:
        # Without quit the browser outlives an exception.
        yield driver
    finally:
        driver.quit()
