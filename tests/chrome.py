"""A real Chromium, driven as a person would: DevTools over a pipe, nothing else to install."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
PHONE, LAPTOP = 390, 1280  # widths of screens in pixels
PATIENCE_S = 180.0
"""Axe looks at a page with many figures for a minute where other processes are at work."""

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
# Chromium reads its orders from file 3 and answers on file 4.
_LAUNCHER = """
import os, sys
os.dup2(int(sys.argv[1]), 103), os.dup2(int(sys.argv[2]), 104)
os.dup2(103, 3), os.dup2(104, 4)
os.set_inheritable(3, True), os.set_inheritable(4, True)
os.execv(sys.argv[3], sys.argv[3:])
"""


class Browser:
    """A running Chromium."""

    def __init__(self, folder: Path) -> None:
        self._answers: dict[int, dict[str, object]] = {}
        self._listeners: dict[str, Callable[[dict[str, object]], None]] = {}
        self._came = threading.Condition()
        self._number = 0
        orders, self._to = os.pipe()
        self._from, answers = os.pipe()
        command = [sys.executable, "-c", _LAUNCHER, str(orders), str(answers), str(BROWSER)]
        self._process = subprocess.Popen(
            [
                *command,
                *FLAGS,
                "--disable-extensions",
                "--remote-debugging-pipe",
                f"--user-data-dir={folder}",
            ],
            pass_fds=(orders, answers),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(orders)
        os.close(answers)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def close(self) -> None:
        """End the browser."""
        self._process.terminate()
        self._process.wait(timeout=PATIENCE_S)
        self._reader.join(timeout=PATIENCE_S)
        os.close(self._to)
        os.close(self._from)

    def listen(self, session: str, listener: Callable[[dict[str, object]], None]) -> None:
        """Give what a session tells, beside its answers, to a listener."""
        self._listeners[session] = listener

    def call(self, method: str, session: str = "", **parameters: object) -> Mapping[str, object]:
        """Give an order and wait for its answer."""
        with self._came:
            self._number += 1
            number = self._number
        order: dict[str, object] = {"id": number, "method": method, "params": parameters}
        if session:
            order["sessionId"] = session
        os.write(self._to, json.dumps(order).encode() + b"\0")
        with self._came:
            if not self._came.wait_for(lambda: number in self._answers, timeout=PATIENCE_S):
                raise TimeoutError(method)
            answer = self._answers.pop(number)
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']}")
        return cast("Mapping[str, object]", answer["result"])

    def _read(self) -> None:
        rest = b""
        while True:
            try:
                block = os.read(self._from, 1 << 20)
            except OSError:
                return
            if not block:
                return
            *messages, rest = (rest + block).split(b"\0")
            for message in messages:
                self._take(json.loads(message))

    def _take(self, message: dict[str, object]) -> None:
        if "id" in message:
            with self._came:
                self._answers[cast("int", message["id"])] = message
                self._came.notify_all()
        elif (listener := self._listeners.get(str(message.get("sessionId")))) is not None:
            listener(message)


class Chrome:
    """One page of a browser, opened by a visitor that the browser has not seen before.

    Attributes:
        errors: what went wrong on the page: exceptions, console errors and warnings, blocked requests.
        requests: addresses that were asked for.
    """

    def __init__(self, home: Path | Browser) -> None:
        self.errors: list[str] = []
        self.requests: list[str] = []
        self._is_own = not isinstance(home, Browser)
        self._browser = home if isinstance(home, Browser) else Browser(home)
        # Cookies, storage and cache are a context's own.
        self._context = self._browser.call("Target.createBrowserContext")["browserContextId"]
        target = self._browser.call("Target.createTarget", url="about:blank", browserContextId=self._context)
        attached = self._browser.call("Target.attachToTarget", targetId=target["targetId"], flatten=True)
        self._session = str(attached["sessionId"])
        self._browser.listen(self._session, self._take)
        for domain in ("Page", "Runtime", "Network", "Log", "DOM"):
            self.call(f"{domain}.enable")

    def close(self) -> None:
        """Close the page and forget its visitor, and end a browser of its own."""
        self._browser.call("Target.disposeBrowserContext", browserContextId=self._context)
        if self._is_own:
            self._browser.close()

    def call(self, method: str, **parameters: object) -> Mapping[str, object]:
        """Give the page an order and wait for its answer."""
        return self._browser.call(method, self._session, **parameters)

    def size(self, width: int, height: int, *, dark: bool = False) -> None:
        """Set the size of the window and the colours that the reader asks for."""
        mobile = width < 600
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=mobile,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def open(self, address: str) -> None:
        """Go to an address."""
        self.call("Page.navigate", url=address)

    def run(self, script: str) -> object:
        """The value of an expression on the page."""
        answer = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(str(answer["exceptionDetails"]))
        return cast("Mapping[str, object]", answer["result"]).get("value")

    def wait(self, condition: str, *, patience_s: float = PATIENCE_S) -> None:
        """Wait until an expression is true."""
        end = time.monotonic() + patience_s
        while not self._holds(condition):
            if time.monotonic() > end:
                shown = str(self.run("document.body.innerText.slice(0, 1500)"))
                raise TimeoutError(f"{condition}\nerrors: {self.errors}\n{shown}")
            time.sleep(0.05)

    def _holds(self, condition: str) -> bool:
        try:
            return bool(self.run(f"Boolean({condition})"))
        except RuntimeError as error:
            # The page was left while it was asked.
            if "navigated or closed" not in str(error):
                raise
            return False

    def click(self, selector: str) -> None:
        """Click the middle of an element, as a person does."""
        self.wait(f"document.querySelector({json.dumps(selector)})")
        box = self.run(
            f"(() => {{ const node = document.querySelector({json.dumps(selector)});"
            " node.scrollIntoView({block: 'center', behavior: 'instant'});"
            " const box = node.getBoundingClientRect();"
            " return [box.left + box.width / 2, box.top + box.height / 2]; })()"
        )
        x, y = cast("list[float]", box)
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def drag(self, selector: str, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Drag over an element, between two places given as shares of its width and height."""
        box = self.run(
            f"(() => {{ const node = document.querySelector({json.dumps(selector)});"
            " node.scrollIntoView({block: 'center', behavior: 'instant'});"
            " const { left, top, width, height } = node.getBoundingClientRect();"
            " return [left, top, width, height]; })()"
        )
        left, top, width, height = cast("list[float]", box)
        steps = [
            tuple(a + share * (b - a) for a, b in zip(start, end, strict=True)) for share in (0.0, 0.5, 1.0)
        ]
        kinds = ("mousePressed", "mouseMoved", "mouseMoved", "mouseReleased")
        for kind, (x, y) in zip(kinds, (*steps, steps[-1]), strict=True):
            place = {"x": left + x * width, "y": top + y * height}
            self.call("Input.dispatchMouseEvent", type=kind, **place, button="left", buttons=1, clickCount=1)

    def press(self, key: str, code: int) -> None:
        """Press a key."""
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, windowsVirtualKeyCode=code)

    def drop(self, path: Path, selector: str) -> None:
        """Drop a file on an element."""
        box = self.run(
            f"(() => {{ const box = document.querySelector({json.dumps(selector)}).getBoundingClientRect();"
            " return [box.left + box.width / 2, box.top + box.height / 2]; })()"
        )
        x, y = cast("list[float]", box)
        data = {"items": [], "files": [str(path)], "dragOperationsMask": 1}
        for kind in ("dragEnter", "dragOver", "drop"):
            self.call("Input.dispatchDragEvent", type=kind, x=x, y=y, data=data)

    def picture(self, path: Path, *, whole: bool = False) -> None:
        """Keep what is seen, or the whole page."""
        path.parent.mkdir(parents=True, exist_ok=True)
        answer = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(str(answer["data"])))

    def _take(self, message: dict[str, object]) -> None:
        told = cast("dict[str, dict[str, object]]", message.get("params", {}))
        match message.get("method"):
            case "Network.requestWillBeSent":
                self.requests.append(str(told["request"]["url"]))
            case "Runtime.exceptionThrown":
                self.errors.append(str(told["exceptionDetails"]))
            case "Runtime.consoleAPICalled" if told.get("type") in {"error", "warning"}:
                self.errors.append(str(told["args"]))
            case "Log.entryAdded" if told["entry"]["level"] in {"error", "warning"}:
                self.errors.append(str(told["entry"].get("text")) + " " + str(told["entry"].get("url")))
