"""Serve the workbench to browsers of this user on this machine only.

The server listens on 127.0.0.1. A page opens with the token of the server; every page has its own bench and its own
secret, which it sends in a header with every request. A request under another host name (DNS rebinding), from another
origin, or without the secret of a page is refused. No page of another origin can read a response, and the page itself
may send requests to this server only. The browser is given a file that only this user can read and that redirects to
the address, because other users can read the command line of the browser.
"""

import json
import secrets
import threading
import warnings
from collections import OrderedDict
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import parse_qs, urlsplit

from optid import __version__
from optid.data.description import RECORD, first_findings
from optid.errors import DataError, OptidError
from optid.registry import FORMULATIONS, find_entry_points
from optid.workbench.bench import Bench, BenchSource
from optid.workbench.request import shortest

PAGES = 16
"""Pages that may be open at a time; the oldest is closed."""

LARGEST = 1 << 20
"""Most bytes of a request."""

SHOWN = ("arx", "hammerstein_arx.exact", "hammerstein_arx.overparametrised", "hammerstein_oe.exact",
         "hammerstein_ss.sivid", "hammerstein_ss.asivid", "hammerstein_ss.exact")
"""Formulations that a page offers: those fast enough for a drag, and the state-space ones for diagnosis."""


class Server(ThreadingHTTPServer):
    """The server of one record.

    Attributes:
        source: the record.
        token: opens a page.
        benches: benches by the secret of their page.
    """

    daemon_threads = True

    def __init__(self, source: BenchSource, port: int = 0) -> None:
        super().__init__(("127.0.0.1", port), _Handler)
        self.source, self.token = source, secrets.token_urlsafe(24)
        self.benches: OrderedDict[str, Bench] = OrderedDict()
        self.lock = threading.Lock()

    @property
    def address(self) -> str:
        """The address of a new page, with the token."""
        return f"http://127.0.0.1:{self.server_port}/?token={self.token}"

    @property
    def hosts(self) -> tuple[str, ...]:
        """Names under which the server answers."""
        return f"127.0.0.1:{self.server_port}", f"localhost:{self.server_port}"

    def redirect(self, folder: Path) -> Path:
        """Write a file, readable by this user only, that redirects to the address."""
        path = folder / "workbench.html"
        path.touch(0o600)
        path.write_text(f'<!DOCTYPE html><meta http-equiv="refresh" content="0; url={self.address}">')
        return path

    def open_page(self) -> str:
        """Return the secret of a new page."""
        secret = secrets.token_urlsafe(24)
        with self.lock:
            self.benches[secret] = Bench(self.source)
            while len(self.benches) > PAGES:
                self.benches.popitem(last=False)
        return secret

    def page(self, secret: str) -> tuple[str, str]:
        """Return the page and its policy."""
        from optid.show.page import embed_json, scripts, template

        data, script = self.source.data, scripts("plot.js", "parts.js", "workbench.js")
        begin = {
            "secret": secret, "start": self.source.start, "name": data.name or "record", "dt": data.dt,
            "dated": data.dated, "samples": shortest(data), "origins": [e.start for e in data.experiments],
            "inputs": list(data.inputs), "outputs": list(data.outputs),
            "formulations": [name for name in SHOWN if name in find_entry_points(FORMULATIONS)]}
        lead = f"{data.n_samples} samples every {data.interval}"
        body = template("workbench.html.j2").render(
            version=__version__, title=data.name or "Record", lead=lead, sections=[], record=RECORD,
            findings=first_findings(data.findings), begin=embed_json(begin),
            script=script["script"])
        return body, (f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{script['digest']}'; "
                      "img-src data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'")


class _Handler(BaseHTTPRequestHandler):
    server: Server
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        """Open a page, given the token; a redirect from a file counts as cross-site."""
        asked = urlsplit(self.path)
        token = parse_qs(asked.query).get("token", [""])[0].encode()
        if not (self._host() and asked.path == "/" and secrets.compare_digest(token, self.server.token.encode())):
            return self._send(403, "Open the address that optid workbench printed, with its token.", "text/plain")
        body, policy = self.server.page(self.server.open_page())
        self._send(200, body, "text/html", policy)

    def do_POST(self) -> None:
        """Respond to a request of a page."""
        bench = self.server.benches.get(self.headers.get("X-Optid-Page", ""))
        size = self.headers.get("Content-Length", "")
        if not self._own() or bench is None or not size.isdecimal() or int(size) > LARGEST:
            self.close_connection = True
            return self._send(403, json.dumps({"error": "the server does not know this page: open it again"}))
        try:
            asked = json.loads(self.rfile.read(int(size)))
            if not isinstance(asked, dict):
                raise DataError("a request must be a JSON object")
            code, answer = 200, bench.answer(self.path.removeprefix("/"), asked)
        except (OptidError, ValueError, TypeError, KeyError) as error:
            code, answer = 400, {"error": f"{type(error).__name__}: {error}"}
        except Exception as error:  # a defect must not leave the page waiting
            code, answer = 500, {"error": f"a defect of optid: {type(error).__name__}: {error}"}
        self._send(code, json.dumps(answer))

    def _host(self) -> bool:
        return self.headers.get("Host") in self.server.hosts

    def _own(self) -> bool:
        """Whether a request to this server was sent by a page of this server."""
        origin = self.headers.get("Origin")
        return self._host() and (
            origin is None or origin in [f"http://{host}" for host in self.server.hosts]) and (
            self.headers.get("Sec-Fetch-Site", "none") in ("none", "same-origin"))

    def _send(self, code: int, text: str, kind: str = "application/json", policy: str = "default-src 'none'") -> None:
        body = text.encode()
        self.send_response(code)
        for key, value in {
            "Content-Type": f"{kind}; charset=utf-8", "Content-Length": str(len(body)), "Cache-Control": "no-store",
            "Content-Security-Policy": policy, "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer",
            "Cross-Origin-Resource-Policy": "same-origin", "Cross-Origin-Opener-Policy": "same-origin",
        }.items():
            self.send_header(key, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing."""


def serve(source: BenchSource, port: int = 0, ready: Callable[[str, Path], None] = print) -> None:
    """Serve a record on a port of 127.0.0.1, by default a free one, until it is interrupted.

    `ready` gets the address, and a file, readable by this user only, that redirects to it. `DataError`: the port is in
    use, or is not a port.
    """
    try:
        server = Server(source, port)
    except (OSError, OverflowError) as error:
        raise DataError(f"port {port} of 127.0.0.1 cannot be used: "
                        f"{getattr(error, 'strerror', 'it must be 0 to 65535')}") from None
    with server, TemporaryDirectory(prefix="optid-") as folder, warnings.catch_warnings(action="ignore"):
        ready(server.address, server.redirect(Path(folder)))
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            return
