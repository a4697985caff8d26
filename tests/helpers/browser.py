"""A headless Chromium driven through its DevTools pipe: keys, mouse, colours, console, requests, pictures."""

import base64
import json
import os
import select
import shlex
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
NO_BROWSER = "no chromium, chromium-browser or google-chrome on PATH"
QUIET = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
         "--disable-background-networking", "--disable-component-update", "--disable-dev-shm-usage")
DRIVEN = ("--allow-pre-commit-input", "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",
          "--remote-debugging-pipe", "--disable-background-timer-throttling", "--disable-renderer-backgrounding",
          "--disable-backgrounding-occluded-windows", "--disable-hang-monitor")
# two frames; a browser that draws none while it is starved of the processor would otherwise never go on
DREW = ("new Promise((done) => { setTimeout(done, 1000); "
        "requestAnimationFrame(() => requestAnimationFrame(done)); })")
KEYS = {"Enter": (13, "\r"), "Tab": (9, ""), "Escape": (27, ""), "ArrowLeft": (37, ""), "ArrowRight": (39, ""),
        "ArrowUp": (38, ""), "ArrowDown": (40, ""), " ": (32, " ")}
# expressions that list what is wrong with a page: texts one over another, ink too close to its ground
OVERLAPS = """[...document.querySelectorAll('.plot svg')].flatMap((svg) => {
  const texts = [...svg.querySelectorAll('text')].map((t) => [t.textContent, t.getBoundingClientRect()]);
  return texts.flatMap(([a, p], i) => texts.slice(i + 1).filter(([, q]) =>
    p.left < q.right - 1 && q.left < p.right - 1 && p.top < q.bottom - 1 && q.top < p.bottom - 1)
    .map(([b]) => `${svg.getAttribute('aria-label')}: ${a} over ${b}`));
})"""

CONTRAST = """(() => {
  const canvas = document.createElement('canvas').getContext('2d', { willReadFrequently: true });
  const rgba = (colour) => { canvas.clearRect(0, 0, 1, 1); canvas.fillStyle = colour; canvas.fillRect(0, 0, 1, 1);
    const d = canvas.getImageData(0, 0, 1, 1).data; return [d[0], d[1], d[2], d[3] / 255]; };
  const over = (top, low) => [0, 1, 2].map((k) => top[k] * top[3] + low[k] * (1 - top[3])).concat(1);
  const light = (c) => [0, 1, 2].map((k) => c[k] / 255)
    .map((v) => v <= .04045 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4)
    .reduce((sum, v, k) => sum + v * [.2126, .7152, .0722][k], 0);
  const found = [];
  for (const one of document.querySelectorAll('body *')) {
    if (![...one.childNodes].some((n) => n.nodeType === 3 && n.data.trim())) continue;
    if (['SCRIPT', 'STYLE', 'NOSCRIPT'].includes(one.tagName)) continue;
    if (!one.getClientRects().length) continue;
    const style = getComputedStyle(one), layers = [];
    for (let up = one; up; up = up.parentElement) layers.push(rgba(getComputedStyle(up).backgroundColor));
    let back = [255, 255, 255, 1];
    for (const layer of layers.reverse()) back = over(layer, back);
    const ink = over(rgba(one instanceof SVGElement ? style.fill : style.color), back);
    const [a, b] = [light(ink), light(back)].sort((p, q) => q - p), ratio = (a + .05) / (b + .05);
    if (ratio < 4.5) found.push(`${one.tagName} "${one.textContent.slice(0, 30)}" ${ratio.toFixed(2)}`);
  }
  return [...new Set(found)];
})()"""


def look(page: Path, folder: Path, *options: str) -> subprocess.CompletedProcess:
    """Let a browser open a file and end: what it prints, and on stderr what its console says."""
    assert CHROMIUM is not None, NO_BROWSER
    words = [CHROMIUM, *QUIET, "--enable-logging=stderr", "--v=0", f"--user-data-dir={folder}", *options]
    return subprocess.run([*words, page.as_uri()], capture_output=True, text=True, timeout=600, check=True)


class BrowserError(RuntimeError):
    """The browser does not answer, or the page threw an exception."""


class Browser:
    """One page of one browser; use it in a ``with`` statement."""

    def __init__(self, profile: Path, patience: float = 180.0) -> None:
        assert CHROMIUM is not None, NO_BROWSER
        self.patience, self.events, self.buffer, self.number = patience, [], b"", 0
        read, self.to = os.pipe()
        self.back, write = os.pipe()
        line = shlex.join([CHROMIUM, *QUIET, *DRIVEN, f"--user-data-dir={profile}", "about:blank"])
        self.process = subprocess.Popen(["bash", "-c", f"exec {line} 3<&{read} 4>&{write}"], pass_fds=(read, write),
                                        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        os.close(read)
        os.close(write)
        self.session = None
        try:
            page = self._first_page()
            self.session = self.send("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]
            for domain in ("Page", "Runtime", "Network", "Log"):
                self.send(f"{domain}.enable")
            self.send("Performance.enable", timeDomain="threadTicks")
        except BaseException:
            self.__exit__()
            raise

    def __enter__(self) -> "Browser":
        return self

    def __exit__(self, *_: Any) -> None:
        try:
            self.session = None
            self.send("Browser.close")
            self.process.wait(10)
        except (BrowserError, OSError, subprocess.TimeoutExpired):
            self.process.kill()
            self.process.wait()
        os.close(self.to)
        os.close(self.back)

    def _first_page(self) -> str:
        """Wait for the page that the browser opens by itself, and return its name."""
        end = time.monotonic() + self.patience
        while time.monotonic() < end:
            for target in self.send("Target.getTargets")["targetInfos"]:
                if target["type"] == "page":
                    return target["targetId"]
            time.sleep(0.02)
        raise BrowserError("the browser opens no page")

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command and return its result."""
        self.number += 1
        message = {"id": self.number, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.to, json.dumps(message).encode() + b"\0")
        end = time.monotonic() + self.patience
        while True:
            answer = self._receive(end)
            if answer.get("id") == self.number:
                if "error" in answer:
                    raise BrowserError(f"{method}: {answer['error']}")
                return answer["result"]
            self.events.append(answer)

    def _receive(self, end: float) -> dict[str, Any]:
        while b"\0" not in self.buffer:
            if not select.select([self.back], [], [], max(0.0, end - time.monotonic()))[0]:
                raise BrowserError("the browser does not answer")
            part = os.read(self.back, 1 << 20)
            if not part:
                raise BrowserError("the browser went away")
            self.buffer += part
        message, self.buffer = self.buffer.split(b"\0", 1)
        return json.loads(message)

    def run(self, script: str) -> Any:
        """Evaluate an expression in the page and return its value."""
        result = self.send("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in result:
            details = result["exceptionDetails"]
            raise BrowserError(details.get("exception", {}).get("description", details["text"]))
        return result["result"].get("value")

    def wait(self, condition: str, patience: float = 60.0) -> None:
        """Wait until an expression is true."""
        end = time.monotonic() + patience
        while not self._holds(condition):
            if time.monotonic() > end:
                raise BrowserError(f"not true after {patience:g} s: {condition}")
            time.sleep(0.02)

    def _holds(self, condition: str) -> bool:
        try:
            return self.run(f"!!({condition})")
        except BrowserError as error:
            if "context" in str(error):  # the page that was asked has just been replaced by the one that comes
                return False
            raise

    def busy(self) -> float:
        """Return the seconds of processor time that the thread of the page has spent on it, other processes or not."""
        found = self.send("Performance.getMetrics")["metrics"]
        return next(one["value"] for one in found if one["name"] == "TaskDuration")

    def open(self, path: Path, ready: str = "document.documentElement?.dataset.ready") -> float:
        """Open a file, wait until it is ready, and return the seconds from the command on."""
        self.run("delete document.documentElement?.dataset.ready")  # what the page before said of itself
        self.events.clear()
        clock = time.perf_counter()
        self.send("Page.navigate", url=Path(path).absolute().as_uri())
        self.wait(ready)
        return time.perf_counter() - clock

    def complaints(self) -> list[str]:
        """Console messages, exceptions and log entries since the page was opened."""
        self.run("1")
        found = []
        for event in self.events:
            if event.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded", "Runtime.consoleAPICalled"):
                found.append(json.dumps(event["params"])[:500])
        return found

    def requests(self) -> list[str]:
        """Addresses asked for since the page was opened, the page itself and what it carries left out."""
        self.run("1")
        asked = [e["params"]["request"]["url"] for e in self.events if e.get("method") == "Network.requestWillBeSent"]
        return [url for url in asked[1:] if not url.startswith(("data:", "blob:"))]

    def press(self, *keys: str) -> None:
        """Press keys one after the other, as a person would."""
        for key in keys:
            code, text = KEYS.get(key, (ord(key.upper()) if len(key) == 1 else 0, key if len(key) == 1 else ""))
            pressed = {"key": key, "windowsVirtualKeyCode": code, **({"text": text} if text else {})}
            self.send("Input.dispatchKeyEvent", type="keyDown", **pressed)
            self.send("Input.dispatchKeyEvent", type="keyUp", key=key, windowsVirtualKeyCode=code)

    def write(self, text: str) -> None:
        """Write text into what has the focus."""
        self.send("Input.insertText", text=text)

    def where(self, selector: str) -> dict[str, float]:
        """Scroll an element into view, let the page come to rest, and return its place in the window."""
        return self.run(f"(async () => {{ const e = document.querySelector({json.dumps(selector)}); "
                        "e.scrollIntoView({block: 'center', behavior: 'instant'}); "
                        f"await {DREW}; const r = e.getBoundingClientRect(); "
                        "return {x: r.x, y: r.y, width: r.width, height: r.height}; })()")

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """Send a mouse event: mouseMoved, mousePressed, mouseReleased, mouseWheel."""
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def click(self, selector: str) -> None:
        """Click into the middle of an element."""
        place = self.where(selector)
        x, y = place["x"] + place["width"] / 2, place["y"] + place["height"] / 2
        self.mouse("mouseMoved", x, y)
        self.mouse("mousePressed", x, y, button="left", clickCount=1)
        self.mouse("mouseReleased", x, y, button="left", clickCount=1)

    def drag(self, selector: str, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Drag inside an element, between two places as shares of its width and height."""
        place = self.where(selector)
        ends = ((place["x"] + a * place["width"], place["y"] + b * place["height"]) for a, b in (start, end))
        (x0, y0), (x1, y1) = ends
        self.mouse("mousePressed", x0, y0, button="left", clickCount=1)
        self.mouse("mouseMoved", (x0 + x1) / 2, (y0 + y1) / 2, button="left")
        self.mouse("mouseMoved", x1, y1, button="left")
        self.mouse("mouseReleased", x1, y1, button="left", clickCount=1)

    def window(self, width: int, height: int, *, dark: bool = False, phone: bool = False) -> None:
        """Set the size of the window and the colours that the person prefers."""
        self.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=phone)
        self.send("Emulation.setEmulatedMedia",
                  features=[{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}])

    def picture(self, path: Path, whole: bool = False) -> Path:
        """Write a picture of the window, or of the whole page, as PNG."""
        area = {}
        if whole:
            size = self.send("Page.getLayoutMetrics")["cssContentSize"]
            area = {"clip": {"x": 0, "y": 0, "width": size["width"], "height": min(size["height"], 8000), "scale": 1}}
        shot = self.send("Page.captureScreenshot", format="png", captureBeyondViewport=whole, **area)
        path.write_bytes(base64.b64decode(shot["data"]))
        return path
