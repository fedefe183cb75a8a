"""The replay page of a flight that is still on: a small server on this machine, for browsers on it."""

from __future__ import annotations

import json
import math
import queue
import threading
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from shortfinal.errors import InputError
from shortfinal.view.page import Columns, check_flight, page_html, row_of, runway_end_m

QUEUE = 4  # frames that wait for one browser; the oldest gives way to the newest
PICTURES = 8  # kept: of the frames that browsers may still be about to show
PATIENCE_S = 10.0  # with a browser that takes nothing
HEARTBEAT_S = 5.0  # of an event stream without frames: finds out whether the browser is still there
HOSTS = ("127.0.0.1", "localhost")  # another name in a request is another site's page reaching for this one


class LiveView:
    """The page at `url`: its frames come as they are written.

    A browser that is slow skips frames, one that is gone is forgotten; neither holds up `write`.
    """

    def __init__(self, flight: dict[str, Any], port: int = 0) -> None:
        """`flight`: what flight.json holds. `port` on 127.0.0.1; 0: any that is free.

        Raises InputError for a flight that the page cannot be drawn from, or a port that cannot be had.
        """
        self._end_m = runway_end_m(check_flight(flight, "flight"))
        self._page = page_html(flight, Columns(), [], live=True).encode("utf-8", "backslashreplace")
        self._lock = threading.Lock()
        self._browsers: set[queue.Queue[bytes | None]] = set()
        self._newest: bytes | None = None
        self._pictures: dict[str, bytes] = {}  # the newest ones, by their path
        self._written = 0
        view = self

        class Handler(_Handler):
            live = view

        try:
            self._server = _Server(("127.0.0.1", port), Handler)
        except (OSError, OverflowError) as error:
            raise InputError(f"port {port}: cannot serve the live view: {error}; choose another, or 0") from error
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}/"
        self._thread = threading.Thread(target=self._server.serve_forever, name="live view", daemon=True)
        self._thread.start()

    def write(self, record: dict[str, Any], jpeg: bytes | None) -> None:
        """Show a frame: what goes into a line of frames.jsonl, and its picture. Never waits for a browser.

        Raises InputError for a record that is none.
        """
        try:
            row = row_of(record, self._end_m)
        except (ValueError, TypeError, KeyError, AttributeError, IndexError) as error:
            raise InputError(f"record: not a frame's ({error!r})") from error
        # JSON knows no infinity: null is a level that cannot be given. What is not known is not there.
        numbers = {name: v if math.isfinite(v) else None for name, v in row.numbers.items() if not math.isnan(v)}
        texts = {name: text for name, text in row.texts.items() if name != "image"}
        self._written += 1
        if jpeg is not None:
            texts["image"] = f"frame/{self._written}.jpg"
        event = f"data: {json.dumps({'numbers': numbers, 'texts': texts}, allow_nan=False)}\n\n".encode()
        with self._lock:
            self._newest = event
            if jpeg is not None:
                self._pictures["/" + texts["image"]] = jpeg
            if len(self._pictures) > PICTURES:
                del self._pictures[next(iter(self._pictures))]
            for waiting in self._browsers:
                _put(waiting, event)

    def close(self) -> None:
        """End the streams and the server. A second call does nothing."""
        with self._lock:
            for waiting in self._browsers:
                _put(waiting, None)
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def join(self) -> queue.Queue[bytes | None]:
        """A new browser's queue, with the newest frame in it."""
        waiting: queue.Queue[bytes | None] = queue.Queue(QUEUE)
        with self._lock:
            if self._newest is not None:
                waiting.put_nowait(self._newest)
            self._browsers.add(waiting)
        return waiting

    def leave(self, waiting: queue.Queue[bytes | None]) -> None:
        """Forget a browser."""
        with self._lock:
            self._browsers.discard(waiting)

    @property
    def page(self) -> bytes:
        """The page, UTF-8."""
        return self._page

    def picture(self, path: str) -> bytes | None:
        """The picture at a path of this server; None if there is none, or no longer."""
        with self._lock:
            return self._pictures.get(path)


def _put(waiting: queue.Queue[bytes | None], event: bytes | None) -> None:
    """Into a bounded queue, without waiting; only one thread puts at a time."""
    while True:
        try:
            return waiting.put_nowait(event)
        except queue.Full:
            with suppress(queue.Empty):
                waiting.get_nowait()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that left in the middle is no news."""


class _Handler(BaseHTTPRequestHandler):
    live: LiveView
    timeout = PATIENCE_S

    def do_GET(self) -> None:
        """The page, its events, its pictures."""
        host = (self.headers.get("Host") or "").rsplit(":", 1)[0]
        path = self.path.partition("?")[0]
        if host not in HOSTS:
            self.send_error(403)
        elif path == "/":
            self._send("text/html; charset=utf-8", self.live.page)
        elif path == "/events":
            self._stream()
        elif (jpeg := self.live.picture(path)) is not None:
            self._send("image/jpeg", jpeg)
        else:
            self.send_error(404)

    def _send(self, kind: str, content: bytes) -> None:
        self._begin(kind, len(content))
        self.wfile.write(content)

    def _begin(self, kind: str, length: int | None = None) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        if length is not None:
            self.send_header("Content-Length", str(length))
        self.end_headers()

    def _stream(self) -> None:
        waiting = self.live.join()
        try:
            self._begin("text/event-stream")
            while True:
                try:
                    event = waiting.get(timeout=HEARTBEAT_S)
                except queue.Empty:
                    event = b": still here\n\n"
                if event is None:
                    self.wfile.write(b"event: end\ndata: {}\n\n")
                    return
                self.wfile.write(event)
        except OSError:  # gone, or too slow
            return
        finally:
            self.live.leave(waiting)

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: the flight owns the terminal."""
