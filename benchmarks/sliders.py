"""Sliders in a browser: times from an event on the page to the new picture.

A JupyterLab of its own on 127.0.0.1, a headless Chromium that opens a notebook of one
cell, and real key presses. The browser's own clock measures both ends: an event's time
stamp, and the first frame after the new image has been loaded.
"""

import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .measure import record, skipped

PROTOCOL = "sliders"
MOVES, QUICK_MOVES = 200, 20
PATIENCE = 180.0  # for a server, a page or the first compilation [s]
CELL = """import fdof_jax as fj
fj.configure(x64=True)
from fdof_jax.pictures.interactive import sliders
sliders()"""

# The page records [time stamp of the event, time of the frame] per picture.
PROBE = """
window.pictures = []; window.event_time = null;
for (const kind of ['keydown', 'change'])
    window.addEventListener(kind, e => { window.event_time = e.timeStamp; }, true);
document.querySelector('.jp-OutputArea img.widget-image').addEventListener(
    'load', () => requestAnimationFrame(
        () => window.pictures.push([window.event_time, performance.now()])));
"""


@contextlib.contextmanager
def jupyterlab(folder: Path) -> Iterator[str]:
    """Returns the address of a JupyterLab on a folder, without user settings."""
    token = os.urandom(16).hex()
    own = folder / ".jupyter"
    settings = {
        name: str(own / name)
        for name in ("JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR",
                     "IPYTHONDIR")
    }  # fmt: skip
    command = [
        sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root",
        "--ServerApp.ip=127.0.0.1", "--ServerApp.port=0",
        f"--IdentityProvider.token={token}", f"--ServerApp.root_dir={folder}",
        "--LabApp.expose_app_in_browser=True",
    ]  # fmt: skip
    with (folder / "server.log").open("w") as log:
        server = subprocess.Popen(
            command, env={**os.environ, **settings}, stdout=log, stderr=log
        )
    try:
        runtime = own / "JUPYTER_RUNTIME_DIR"
        files = waited("JupyterLab", lambda: [*runtime.glob("jpserver-*.json")])
        address = json.loads(files[0].read_text())
        yield f"http://127.0.0.1:{address['port']}/doc/tree/{{}}?token={token}"
    finally:
        server.terminate()
        server.wait()


@contextlib.contextmanager
def chromium() -> Iterator[Any]:
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for argument in ("headless=new", "no-sandbox", "disable-dev-shm-usage",
                     "window-size=1400,1000"):  # fmt: skip
        options.add_argument(f"--{argument}")
    service = webdriver.ChromeService(shutil.which("chromedriver"))
    browser = webdriver.Chrome(options=options, service=service)
    try:
        yield browser
    finally:
        browser.quit()


def waited(what: str, found: Callable[[], Any], patience: float = PATIENCE) -> Any:
    """Returns the result of a function as soon as there is one."""
    began = time.perf_counter()
    while not (value := found()):
        if time.perf_counter() - began > patience:
            raise TimeoutError(f"{what}: not there after {patience:g} s.")
        time.sleep(0.02)
    return value


def opened(browser: Any, address: str) -> None:
    """Opens a notebook and runs all of its cells."""
    browser.get(address)
    ready = """
        const shell = window.jupyterapp && window.jupyterapp.shell;
        const panel = shell && shell.currentWidget;
        const session = panel && panel.sessionContext;
        return session && session.session && session.session.kernel &&
            session.session.kernel.status === 'idle';
    """
    waited("kernel", lambda: browser.execute_script(ready))
    browser.execute_script("jupyterapp.commands.execute('notebook:run-all-cells')")


def moved(browser: Any, move: Callable[[int], Any], moves: int) -> list[float]:
    """Returns latencies [s] of several moves; each follows the answer to the last."""
    browser.execute_script("window.pictures = []")
    for i in range(moves):
        move(i)
        answered = f"return window.pictures.length > {i}"
        waited("picture", lambda a=answered: browser.execute_script(a))
        time.sleep(0.1)  # a hand rests between two moves
    pictures = np.array(browser.execute_script("return window.pictures"))
    return (1e-3 * (pictures[:, 1] - pictures[:, 0])).tolist()


def held(browser: Any, press: Callable[[int], Any], moves: int) -> list[float]:
    """Returns times between pictures [s] under too many key presses to answer."""
    browser.execute_script("window.pictures = []")
    for i in range(moves):
        press(i)
    time.sleep(1.0)
    pictures = np.array(browser.execute_script("return window.pictures"))
    return (1e-3 * np.diff(pictures[:, 1])).tolist()


def run(quick: bool) -> Iterator[dict]:
    try:
        from selenium.webdriver.common.by import By
        from selenium.webdriver.common.keys import Keys
        from selenium.webdriver.support.select import Select
    except ImportError:
        yield skipped(PROTOCOL, "sliders", "selenium is not installed")
        return
    if not (shutil.which("chromium") and shutil.which("chromedriver")):
        yield skipped(PROTOCOL, "sliders", "chromium or chromedriver is not installed")
        return
    moves = QUICK_MOVES if quick else MOVES
    with tempfile.TemporaryDirectory() as folder:
        import nbformat

        book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(CELL)])
        # Without a kernel name a dialog asks for one.
        book.metadata.kernelspec = {"name": "python3", "display_name": "Python 3"}
        nbformat.write(book, Path(folder, "sliders.ipynb"))
        with jupyterlab(Path(folder)) as address, chromium() as browser:
            opened(browser, address.format("sliders.ipynb"))
            find = lambda css: browser.find_elements(By.CSS_SELECTOR, css)
            waited("picture", lambda: find(".jp-OutputArea img.widget-image"))
            time.sleep(2.0)
            browser.execute_script(PROBE)
            handles = find(".jp-OutputArea .noUi-handle")
            choice = Select(find(".jp-OutputArea select")[0])

            def press(handle, i):
                handle.send_keys(Keys.ARROW_RIGHT if i // 10 % 2 else Keys.ARROW_LEFT)

            kinds = {
                "lengths": lambda i: press(handles[i % 3], i),
                "gains": lambda i: press(handles[3 + i % 6], i),
                "topology": lambda i: choice.select_by_index((i + 1) % 7),
            }
            for kind, move in kinds.items():
                yield _record(kind, moved(browser, move, moves))
            between = held(browser, lambda i: press(handles[0], i), moves)
            yield _record("between pictures, key held down", between)


def _record(kind: str, times: list[float]) -> dict:
    low, median, high, most = np.percentile(times, [25, 50, 75, 95])
    return record(
        protocol=PROTOCOL,
        problem=kind,
        solver="fdof_jax",
        times=times,
        time_min=min(times),
        time_median=median,
        time_quartiles=[low, high],
        time_95=most,
        under_100_ms=float(np.mean(np.array(times) < 0.1)),
    )
