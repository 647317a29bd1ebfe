"""A browser for tests: headless Chromium, driven by chromedriver over HTTP."""

import base64
import contextlib
import json
import shutil
import subprocess
import tempfile
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

FLAGS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--hide-scrollbars",
]  # fmt: skip


NAMES = "chromium", "chromium-browser", "google-chrome"
PROGRAM = next(filter(None, map(shutil.which, NAMES)), None)
DRIVER = shutil.which("chromedriver")


class Browser:
    """One page: commands of WebDriver, and of Chromium's DevTools by `devtools`."""

    def __init__(self, address: str, profile: str):
        self.address = address
        options = {"binary": PROGRAM, "args": [*FLAGS, f"--user-data-dir={profile}"]}
        wanted = {
            "goog:chromeOptions": options,
            "goog:loggingPrefs": {"browser": "ALL"},
        }
        reply = self.post("/session", {"capabilities": {"alwaysMatch": wanted}})
        self.address += f"/session/{reply['sessionId']}"

    def post(self, place: str, body: Any, method: str = "POST") -> Any:
        text = json.dumps(body).encode() if method == "POST" else None
        kind = {"Content-Type": "application/json"}
        request = urllib.request.Request(
            self.address + place, text, kind, method=method
        )
        # No proxy is asked: the driver is on this machine.
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        try:
            with opener.open(request, timeout=120) as reply:
                return json.load(reply)["value"]
        except urllib.error.HTTPError as error:
            raise RuntimeError(json.load(error)["value"]["message"]) from error

    def open(self, path: Path) -> None:
        self.post("/url", {"url": path.resolve().as_uri()})

    def run(self, script: str, *arguments: Any) -> Any:
        """Runs the body of a function and returns its result, or that of a promise."""
        return self.post("/execute/sync", {"script": script, "args": arguments})

    def press(self, *keys: str) -> None:
        """Presses keys by their names in events, one after the other."""
        for key in keys:
            self.run(
                "document.body.dispatchEvent(new KeyboardEvent('keydown', "
                "{key: arguments[0], bubbles: true, cancelable: true}))",
                key,
            )
        self.drawn()

    def drawn(self) -> None:
        """Waits until two frames are drawn."""
        self.run(
            "return new Promise(done => requestAnimationFrame("
            "() => requestAnimationFrame(() => done(1))))"
        )

    def devtools(self, command: str, **parameters: Any) -> Any:
        return self.post("/goog/cdp/execute", {"cmd": command, "params": parameters})

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """Moves, presses, releases or turns the mouse at a place of the page."""
        held = kind in ("mousePressed", "mouseMoved")
        self.devtools(
            "Input.dispatchMouseEvent", type=kind, x=x, y=y, clickCount=1, **more,
            button="none" if kind == "mouseWheel" else "left", buttons=int(held),
        )  # fmt: skip

    def size(self, width: int, height: int) -> None:
        self.devtools(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=False,
        )  # fmt: skip
        self.drawn()

    def scheme(self, name: str) -> None:
        feature = {"name": "prefers-color-scheme", "value": name}
        self.devtools("Emulation.setEmulatedMedia", features=[feature])
        self.drawn()

    def screenshot(self) -> bytes:
        return base64.b64decode(self.post("/screenshot", None, "GET"))

    def console(self) -> list[str]:
        """Returns the messages since the last call."""
        return [entry["message"] for entry in self.post("/se/log", {"type": "browser"})]


@contextlib.contextmanager
def browser():
    """Starts a browser and ends it."""
    assert DRIVER
    command = [DRIVER, "--port=0"]
    driver = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert driver.stdout
        lines = iter(driver.stdout.readline, "")
        port = next(line.split()[-1].rstrip(".") for line in lines if "success" in line)
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
            page = Browser(f"http://127.0.0.1:{port}", profile)
            yield page
            page.post("", None, "DELETE")
            time.sleep(0.2)  # until it has closed its profile
    finally:
        driver.terminate()
        driver.wait()
