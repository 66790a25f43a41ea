"""A page in a real browser, from the file system, without a network."""

from pathlib import Path
from typing import Any

ADVICE = ("Canvas2D: Multiple readback operations", "GPU stall due to ReadPixels")
"""Warnings about the speed of plotly's plots in space."""


class Visit:
    """A browser page and all its faults: errors, warnings, failed requests, network requests."""

    def __init__(self, browser: Any, site: Path, **options: Any) -> None:
        self.site = site
        self.context = browser.new_context(offline=True, **options)
        self.page = self.context.new_page()
        self.faults: list[str] = []
        self.page.on("console", self._on_message)
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.on("requestfailed", self._on_failure)
        self.page.on("request", self._on_request)

    def _on_message(self, message: Any) -> None:
        if message.type in ("error", "warning") and not any(advice in message.text for advice in ADVICE):
            self.faults.append(message.text)

    def _on_request(self, request: Any) -> None:
        if not request.url.startswith(("file:", "data:", "blob:")):
            self.faults.append(f"network request for {request.url}")

    def _on_failure(self, request: Any) -> None:
        if request.failure != "net::ERR_ABORTED":  # the page was left while it was loading
            self.faults.append(f"{request.failure}: {request.url}")

    def open(self, address: str) -> None:
        path, _, fragment = address.partition("#")
        target = (self.site / path).as_uri() if path != "about:blank" else path
        self.page.goto(f"{target}{'#' + fragment if fragment else ''}")
        self.page.wait_for_load_state("load")

    def draw(self) -> int:
        """Draw every chart, also those outside the view; returns their number."""
        figures = self.page.locator("figure.chart")
        self.page.evaluate("phdExp.drawAll()")
        self.page.wait_for_function(
            "document.querySelectorAll('figure.chart').length === document.querySelectorAll('figure.drawn').length"
        )
        return figures.count()

    def width_beyond(self) -> int:
        return self.page.evaluate("document.documentElement.scrollWidth - window.innerWidth")

    def open_details(self) -> None:
        self.page.evaluate("document.querySelectorAll('details').forEach(details => { details.open = true; })")
