"""A headless Chromium, driven through its DevTools protocol."""

from __future__ import annotations

import base64
import contextlib
import http.client
import itertools
import json
import shutil
import subprocess
import time
import urllib.parse
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from websockets.sync.client import connect

CHROMIUM = next((path for path in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if path), None)
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--hide-scrollbars",
    "--force-device-scale-factor=1",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--remote-debugging-port=0",
)
PATIENCE_S = 60.0


class Page:
    """One tab: open a file, run scripts, press keys, move the pointer, and keep a list of what it requested."""

    def __init__(self, socket):
        self._socket = socket
        self._ids = itertools.count(1)
        self.requests: list[str] = []
        self.errors: list[str] = []
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method, **parameters):
        """The result of one command; events that come meanwhile are taken note of."""
        number = next(self._ids)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=PATIENCE_S))
            if message.get("id") == number:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error']['message']}")
                return message["result"]
            self._note(message)

    def _note(self, event):
        if event["method"] == "Network.requestWillBeSent":
            self.requests.append(event["params"]["request"]["url"])
        elif event["method"] == "Runtime.exceptionThrown":
            self.errors.append(json.dumps(event["params"]["exceptionDetails"])[:600])
        elif event["method"] == "Log.entryAdded" and event["params"]["entry"]["level"] == "error":
            self.errors.append(event["params"]["entry"]["text"])

    def size(self, width, height, *, mobile=False):
        """Make the window that large."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": mobile}
        self.call("Emulation.setDeviceMetricsOverride", **metrics)

    def open(self, path, fragment=""):
        """Open a page from its file, and wait until it has drawn."""
        url = "file://" + urllib.parse.quote(str(Path(path).resolve())) + (f"#{fragment}" if fragment else "")
        self.call("Page.navigate", url="about:blank")
        self.requests.clear()
        self.errors.clear()
        self.call("Page.navigate", url=url)
        self.until("window.reflectsep && reflectsep.ready()")
        return url

    def run(self, script):
        """Value of a JavaScript expression; promises are waited for."""
        said = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in said:
            raise RuntimeError(json.dumps(said["exceptionDetails"])[:600])
        return said["result"].get("value")

    def until(self, condition):
        """Wait until a JavaScript expression holds."""
        end = time.monotonic() + PATIENCE_S
        while not self.run(f"Boolean({condition})"):
            assert time.monotonic() < end, f"never: {condition}; errors of the page: {self.errors}"
            time.sleep(0.02)

    def settle(self, **state):
        """Set the state and wait until it is drawn."""
        if state:
            self.run(f"reflectsep.set({json.dumps(state)})")
        self.until("reflectsep.ready()")

    def state(self):
        """The state of the page."""
        return self.run("reflectsep.state()")

    def key(self, key, *, shift=False):
        """Press and release a key."""
        modifiers = 8 if shift else 0
        text = {"text": key} if len(key) == 1 else {}
        self.call("Input.dispatchKeyEvent", type="keyDown", key=key, modifiers=modifiers, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=key, modifiers=modifiers)
        self.settle()

    def box(self, selector):
        """(left, top, width, height) of an element in the window, scrolled into it."""
        script = f"""(() => {{ const e = document.querySelector({json.dumps(selector)});
            e.scrollIntoView({{block: "nearest"}});
            const b = e.getBoundingClientRect(); return [b.left, b.top, b.width, b.height]; }})()"""
        return self.run(script)

    def drag(self, start, end, *, button="left", steps=4):
        """Press the mouse at `start`, move it to `end`, let go."""
        mouse = {"button": button, "buttons": {"left": 1, "right": 2}[button], "clickCount": 1}
        self.call("Input.dispatchMouseEvent", type="mousePressed", x=start[0], y=start[1], **mouse)
        for k in range(1, steps + 1):
            x, y = (start[i] + (end[i] - start[i]) * k / steps for i in (0, 1))
            self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y, **mouse)
        self.call("Input.dispatchMouseEvent", type="mouseReleased", x=end[0], y=end[1], **mouse)
        self.settle()

    def touch(self, *fingers):
        """Move fingers along: each a list of places, all of one length."""
        for k in range(len(fingers[0])):
            points = [{"x": finger[k][0], "y": finger[k][1], "id": i} for i, finger in enumerate(fingers)]
            self.call("Input.dispatchTouchEvent", type="touchMove" if k else "touchStart", touchPoints=points)
        self.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
        self.settle()

    def pixels(self, what="canvas_png"):
        """The canvas, or with `picture` the picture at its own resolution: (height, width, 3), 8 bit."""
        return decoded(self.run(f"reflectsep.{what}()").split(",", 1)[1])

    def screenshot(self, path=None):
        """What the window shows, (height, width, 3)."""
        data = self.call("Page.captureScreenshot", format="png")["data"]
        if path is not None:
            Path(path).write_bytes(base64.b64decode(data))
        return decoded(data)


def decoded(text):
    """Pixels of a PNG in base64."""
    return np.asarray(imagecodecs.png_decode(base64.b64decode(text)))[..., :3]


@contextlib.contextmanager
def chromium(folder):
    """A browser with a profile of its own in `folder`."""
    command = [CHROMIUM, *FLAGS, f"--user-data-dir={folder}", "about:blank"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        port = listening_at(process)
        with connect(f"ws://127.0.0.1:{port}{first_tab(port)}", max_size=None) as socket:
            yield Page(socket)
    finally:
        process.terminate()
        process.wait(timeout=20)
        process.stderr.close()


def listening_at(process):
    """Port of the DevTools of a browser that is starting."""
    for line in process.stderr:
        if line.startswith("DevTools listening on"):
            return urllib.parse.urlsplit(line.split()[-1]).port
    raise RuntimeError("the browser ended before it listened")


def first_tab(port):
    """Path of the first tab's socket."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
        connection.request("GET", "/json/list")
        tabs = [tab for tab in json.loads(connection.getresponse().read()) if tab["type"] == "page"]
        connection.close()
        if tabs:
            return urllib.parse.urlsplit(tabs[0]["webSocketDebuggerUrl"]).path
        time.sleep(0.1)
    raise RuntimeError("the browser has no tab")


@pytest.fixture(scope="session")
def page(tmp_path_factory):
    """A tab of a browser; skipped where there is no Chromium."""
    if CHROMIUM is None:
        pytest.skip("no chromium here")
    with chromium(tmp_path_factory.mktemp("profile")) as tab:
        yield tab
