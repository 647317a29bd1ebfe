"""A browser for tests: headless Chromium, driven by chromedriver over HTTP."""

import contextlib
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request

FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-sync"
)
FLAGS += " --disable-background-networking --disable-component-update --hide-scrollbars"
NAMES = "chromium", "chromium-browser", "google-chrome"
PROGRAM = next(filter(None, map(shutil.which, NAMES)), None)
DRIVER = shutil.which("chromedriver")
HTTP = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # no proxy


class Browser:
    """One page: commands of WebDriver, and of Chromium's DevTools by `devtools`."""

    def __init__(self, address, profile):
        self.address = address
        flags = [*FLAGS.split(), f"--user-data-dir={profile}"]
        wanted = {"goog:chromeOptions": {"binary": PROGRAM, "args": flags}}
        wanted["goog:loggingPrefs"] = {"browser": "ALL"}
        reply = self.post("/session", capabilities={"alwaysMatch": wanted})
        self.address += f"/session/{reply['sessionId']}"

    def post(self, place, method="POST", **body):
        kind = {"Content-Type": "application/json"}
        text = json.dumps(body).encode()
        request = urllib.request.Request(
            self.address + place, text, kind, method=method
        )
        with HTTP.open(request, timeout=120) as reply:
            return json.load(reply)["value"]

    def open(self, path):
        self.post("/url", url=path.resolve().as_uri())

    def run(self, script, *arguments):
        """Runs the body of a function and returns its result, or that of a promise."""
        return self.post("/execute/sync", script=script, args=arguments)

    def press(self, *keys):
        """Presses keys by their names in events, one after the other."""
        event = "new KeyboardEvent('keydown', {key, bubbles: true, cancelable: true})"
        script = f"for (const key of arguments[0]) document.body.dispatchEvent({event})"
        self.run(script, keys)
        self.drawn()

    def drawn(self):
        """Waits until two frames are drawn."""
        frames = "requestAnimationFrame(() => requestAnimationFrame(() => done(1)))"
        self.run(f"return new Promise(done => {frames})")

    def devtools(self, command, **parameters):
        return self.post("/goog/cdp/execute", cmd=command, params=parameters)

    def mouse(self, kind, x, y, **more):
        """Moves, presses, releases or turns the mouse at a place of the page."""
        more["buttons"] = int(kind in ("mousePressed", "mouseMoved"))
        more["button"] = "none" if kind == "mouseWheel" else "left"
        place = dict(type=kind, x=x, y=y, clickCount=1)
        self.devtools("Input.dispatchMouseEvent", **place, **more)
        self.drawn()

    def size(self, width, height):
        size = dict(width=width, height=height, deviceScaleFactor=1, mobile=False)
        self.devtools("Emulation.setDeviceMetricsOverride", **size)
        self.drawn()

    def scheme(self, name):
        feature = {"name": "prefers-color-scheme", "value": name}
        self.devtools("Emulation.setEmulatedMedia", features=[feature])
        self.drawn()


@contextlib.contextmanager
def browser():
    """Starts a browser and ends it."""
    command = [str(DRIVER), "--port=0"]
    driver = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        lines = iter(driver.stdout.readline, "")  # type: ignore[union-attr]
        port = next(line.split()[-1].rstrip(".") for line in lines if "success" in line)
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
            page = Browser(f"http://127.0.0.1:{port}", profile)
            yield page
            page.post("", "DELETE")
            time.sleep(0.2)  # until it has closed its profile
    finally:
        driver.terminate()
        driver.wait()
