"""Headless Chromium over its DevTools pipe, with nothing but the standard library: open a page,
press keys, look."""

import base64
import fcntl
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import pytest

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-sync",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--no-default-browser-check",
    "--remote-debugging-pipe",
)
SECONDS = 60.0


def chromium() -> str:
    """The browser's path; in CI a missing one is a failure, elsewhere the test is skipped."""
    path = shutil.which("chromium") or shutil.which("chromium-browser")
    if path is None and os.environ.get("CI", "").lower() in ("1", "true"):
        pytest.fail("CI has no chromium; .ci/run installs it with: apt-get install chromium")
    if path is None:
        pytest.skip("no chromium here; apt-get install chromium")
    return path


class Browser:
    """One browser with one page. Console messages, exceptions and requests are collected as they
    come."""

    def __init__(self) -> None:
        path = chromium()
        self._home = tempfile.TemporaryDirectory(
            prefix="fpp-bench-chromium-", ignore_cleanup_errors=True
        )
        browser_in, self._out = os.pipe()
        self._in, browser_out = os.pipe()
        # The browser reads commands from 3 and answers on 4; ours are moved out of the way of those
        # numbers first.
        read, write = (fcntl.fcntl(fd, fcntl.F_DUPFD, 100) for fd in (browser_in, browser_out))

        def place() -> None:
            os.dup2(read, 3)
            os.dup2(write, 4)

        self._process = subprocess.Popen(
            [path, *FLAGS, f"--user-data-dir={self._home.name}", "about:blank"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            preexec_fn=place,
            pass_fds=(3, 4),
            start_new_session=True,
        )
        for descriptor in (browser_in, browser_out, read, write):
            os.close(descriptor)
        self._pending, self._number = b"", 0
        self._session: str | None = None
        self.events: list[dict[str, Any]] = []
        targets = self.call("Target.getTargets")["targetInfos"]
        target = next(info["targetId"] for info in targets if info["type"] == "page")
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)[
            "sessionId"
        ]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.call("Page.setLifecycleEventsEnabled", enabled=True)

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Answer of one DevTools command; events that come meanwhile are kept."""
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": params}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._number:
                assert "error" not in answer, (method, answer["error"])
                return answer["result"]
            self.events.append(answer)

    def _next(self) -> dict[str, Any]:
        until = time.monotonic() + SECONDS
        while b"\0" not in self._pending:
            ready, _, _ = select.select([self._in], [], [], max(0.0, until - time.monotonic()))
            assert ready, f"chromium did not answer within {SECONDS:g} s"
            data = os.read(self._in, 1 << 20)
            assert data, f"chromium went away (exit status {self._process.poll()})"
            self._pending += data
        message, _, self._pending = self._pending.partition(b"\0")
        return json.loads(message)

    def _go(self, address: str) -> None:
        """Navigate, and wait until the load of that very document is over."""
        loader = self.call("Page.navigate", url=address).get("loaderId")
        over = {"name": "load", "loaderId": loader}
        while not any(
            event.get("method") == "Page.lifecycleEvent" and over.items() <= event["params"].items()
            for event in self.events
        ):
            self.events.append(self._next())

    def open(
        self, page: Path | str, width: int = 1280, height: int = 900, dark: bool = False
    ) -> None:
        """Load a file or an address in a window of that size and wait until it is there."""
        phone = width < 600
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=phone,
        )
        scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.call("Emulation.setEmulatedMedia", features=scheme)
        self._go("about:blank")  # or a change of the fragment alone would load nothing
        self.events.clear()
        self._go(page.resolve().as_uri() if isinstance(page, Path) else page)

    def run(self, script: str) -> Any:
        """Value of a JavaScript expression on the page; an exception in it fails the test."""
        answer = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def click(self, selector: str) -> None:
        """Move to the middle of the first element that matches, and press the mouse there, as a
        person does."""
        element = f"document.querySelector({json.dumps(selector)})"
        box = self.run(
            f"{element}.scrollIntoView({{block: 'center'}}), "
            f"{element}.getBoundingClientRect().toJSON()"
        )
        place = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
        self.call("Input.dispatchMouseEvent", type="mouseMoved", **place)
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, button="left", clickCount=1, **place)

    def key(self, name: str, text: str = "") -> None:
        """Press one key, like ``Tab`` or ``Enter`` (whose ``text`` is a carriage return)."""
        code = {"Tab": 9, "Enter": 13, " ": 32}.get(name, 0)
        for kind in ("keyDown", "keyUp"):
            extra = {"text": text} if text and kind == "keyDown" else {}
            self.call(
                "Input.dispatchKeyEvent",
                type=kind,
                key=name,
                code=name,
                windowsVirtualKeyCode=code,
                **extra,
            )

    def type(self, text: str) -> None:
        self.call("Input.insertText", text=text)

    def complaints(self) -> list[str]:
        """What the console, the page's code or its policy complained about since the page was
        opened."""
        self.run("1")  # everything before this has come by now
        complaints = []
        for event in self.events:
            method, params = event.get("method"), event.get("params", {})
            if method in ("Runtime.exceptionThrown", "Log.entryAdded"):
                complaints.append(json.dumps(params))
            elif method == "Runtime.consoleAPICalled":
                complaints.append(json.dumps(params["args"]))
        return complaints

    def requests(self) -> list[str]:
        """Addresses that were asked for since the page was opened, without data: addresses."""
        self.run("1")
        urls = [
            event["params"]["request"]["url"]
            for event in self.events
            if event.get("method") == "Network.requestWillBeSent"
        ]
        return [url for url in urls if not url.startswith("data:")]

    def picture(self, path: Path, whole: bool = False) -> Path:
        """Screenshot as PNG: of the window, or of the ``whole`` page."""
        answer = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        if whole:
            size = self.call("Page.getLayoutMetrics")["cssContentSize"]
            clip = {**size, "scale": 1}
            answer = self.call(
                "Page.captureScreenshot", format="png", captureBeyondViewport=True, clip=clip
            )
        path.write_bytes(base64.b64decode(answer["data"]))
        return path

    def close(self) -> None:
        """End the browser we started, and its children."""
        try:
            self._session = None
            self.call("Browser.close")
            self._process.wait(10)
        except (AssertionError, OSError, subprocess.TimeoutExpired):
            self._process.kill()
            self._process.wait()
        os.close(self._in)
        os.close(self._out)
        self._home.cleanup()
