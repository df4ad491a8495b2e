"""A minimal W3C WebDriver client for headless Chromium, with what the tests need."""

import base64
import contextlib
import json
import shutil
import socket
import subprocess
import time
import urllib.error
import urllib.request

import pytest


ARGUMENTS = (
    *("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=900,500"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking"),
)
NO_PROXY = urllib.request.build_opener(urllib.request.ProxyHandler({}))


def free_port():
    """Return a port of this computer that is free."""
    with socket.create_server(("127.0.0.1", 0)) as one:
        return one.getsockname()[1]


class Browser:
    """One browser window."""

    def __init__(self, address):
        self.session = address + "/session"
        binary = shutil.which("chromium") or shutil.which("google-chrome")
        options = {"goog:chromeOptions": {"args": ARGUMENTS, "binary": binary}}
        made = self.call("POST", "", {"capabilities": {"alwaysMatch": options}})
        self.session += "/" + made["sessionId"]

    def call(self, method, command, body=None):
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self.session + command, data, method=method)
        with NO_PROXY.open(request, timeout=60) as answer:
            return json.load(answer)["value"]

    def run(self, script, *arguments):
        return self.call("POST", "/execute/sync", {"script": script, "args": arguments})

    def open(self, url):
        self.call("POST", "/url", {"url": url})

    def wait(self, script, *arguments, seconds=30):
        """Run a script until it returns something true, and return that."""
        end = time.monotonic() + seconds
        while not (found := self.run(script, *arguments)):
            assert time.monotonic() < end, f"still nothing: {script}"
            time.sleep(0.1)
        return found

    def press(self, text):
        """Click the button with this text."""
        script = "return [...document.querySelectorAll('button')].find("
        script += "one => one.innerText.trim() == arguments[0])"
        element = self.wait(script, text)
        for last in (False, False, True):
            try:
                return self.call("POST", f"/element/{next(iter(element.values()))}/click", {})
            except urllib.error.HTTPError:  # a panel that is still opening
                if last:
                    raise
                time.sleep(1)

    def click_in_the_middle(self):
        """Click in the middle of the window."""
        x, y = self.run("return [innerWidth, innerHeight].map(side => Math.floor(side / 2))")
        moves = [{"type": "pointerMove", "x": x, "y": y}, {"type": "pause", "duration": 200}]
        presses = [{"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0}]
        mouse = {"type": "pointer", "id": "mouse", "actions": moves + presses}
        self.call("POST", "/actions", {"actions": [mouse]})

    def screenshot(self):
        """Return a PNG of the window, as bytes."""
        return base64.b64decode(self.call("GET", "/screenshot"))


@contextlib.contextmanager
def open_browser():
    """Open a browser for the duration of the context; skip the test if none is installed."""
    if not (shutil.which("chromium") or shutil.which("google-chrome")):
        pytest.skip("needs Chromium (Debian's package chromium)")
    if not shutil.which("chromedriver"):
        pytest.skip("needs chromedriver (Debian's package chromium-driver)")
    port = free_port()
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    driver = subprocess.Popen(["chromedriver", f"--port={port}"], **silent)
    try:
        for _ in range(100):
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port)):
                break
            time.sleep(0.1)
        browser = Browser(f"http://127.0.0.1:{port}")
        try:
            yield browser
        finally:
            browser.call("DELETE", "")
    finally:
        driver.terminate()
        driver.wait()
