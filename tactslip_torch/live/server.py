"""The page of ``export/web`` as a scope: a sink that serves it, and sends all it takes to it.

One port of one server: a WebSocket at ``/ws``, and the few files of the page. What the messages
hold stands at ``PageServer``.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import json
import logging
import secrets
import socket
import struct
import threading
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar
from urllib.parse import parse_qs, quote, unquote, urlsplit

from tactslip_torch.data.formats._reading import needs
from tactslip_torch.live.sinks import (
    Block,
    Counts,
    Event,
    Notices,
    Placed,
    Sink,
    decision_columns,
    merged,
)
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decisions import AlarmSettings, Decisions
from tactslip_torch.runtime import plain

if TYPE_CHECKING:
    from websockets.asyncio.server import Server, ServerConnection
    from websockets.http11 import Request, Response

_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".mjs": "text/javascript; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".png": "image/png",
    ".svg": "image/svg+xml",
}
_STATES = ("connected", "waiting", "lost", "ended")
_TICK_S, _STATUS_S = 0.02, 1.0
_WAITING_S = 2.0  # of samples that may wait for one page
_MOST_TEXTS = 2000  # that may wait for one page; one that is further behind is sent away
_MOST_PAGES = 16
_MOST_OTHERS = 16  # connections that are no open page
_BACKLOG = 8  # connections that are taken at once, so that files for them do not run out
_IDLE_S = 10.0  # in which a request must have come and been answered
_LEAST_TOKEN = 8
_WRONG_TOKEN_S = 0.5
_LAST_WORDS_S = 1.0


def _is_loopback_name(host: str) -> bool:
    """Whether an address is of this machine alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def page_metadata(detector: SlipDetector, settings: AlarmSettings) -> dict[str, Any]:
    """What the page shows of a detector: the metadata of its ``stream.onnx``, and more."""
    from tactslip_torch.deploy.bins import host_metadata  # brings onnx

    names = detector.pool.hand.names
    facts = host_metadata(detector, "stream", "float32") | {
        "threshold": settings.alarm_threshold,
        "units": str(detector.info.get("units", "V")),
        "used_channels": [names[i] for i in detector.needed_index.tolist()],
    }
    return dict(plain(facts))


class PageServer(Sink):
    """A sink that shows the stream on a page.

    ``GET live.json`` gives ``{"socket": "ws", "token_needed": bool}``. The socket sends, in text:
    ``hello`` with ``facts``, ``simulated`` and ``source``; ``decisions`` with ``columns``, as
    ``decision_columns`` names them; and ``status`` with ``state`` (connected, waiting, lost,
    ended), ``received``, ``dropped``, ``dropped_to_page`` and ``text``, each second and at each
    event. Samples are binary, little-endian: uint32 1, uint32 rows, float64 index of the first
    since the stream's start, float32 rows by channels. Times count from the stream's start.

    A page that is too slow misses samples, and gets their number; nothing waits for it.

    A request is refused if it comes from another site's page, or, on loopback, by another name;
    the socket also without the token, where there is one: of all wrong tokens one in half a second
    is answered. At most 16 pages are open, and 16 other connections: a further one takes the place
    of the oldest of these. A connection without a request is closed after 10 s, a page that answers
    no ping after 40 s.

    Args:
        folders: by the path that they are served under, ``""`` for the top, what holds the page.
        facts: of the detector (``page_metadata``).
        source: name of the source.
        simulated: whether samples are known to be simulated.
        counts: of the stream, which change.
        host: address to listen at; beyond loopback there is always a token.
        port: to listen at, 0 for any that is free.
        token: that a page must give; ``None``: on loopback none, else one at random.
        report: is given an ``Event`` where a connection cannot be taken.

    Attributes:
        address: of the page, with the token.
        port: that it listens at.

    Raises:
        ValueError: if websockets is not installed, or a token is too short.
        OSError: if the port is taken.
    """

    def __init__(
        self,
        folders: Mapping[str, Path],
        facts: Mapping[str, Any],
        *,
        source: str,
        simulated: bool,
        counts: Counts,
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
        report: Callable[[Event], object] = lambda event: None,
    ) -> None:
        needs("websockets", "serve=true")
        self._is_loopback = _is_loopback_name(host)
        if token is None and not self._is_loopback:
            token = secrets.token_urlsafe(16)
        if token is not None and len(token) < _LEAST_TOKEN:
            raise ValueError(
                f"token must have at least {_LEAST_TOKEN} characters, got {len(token)}"
            )
        self._token, self._host, self._counts = token, host, counts
        self._files = _files_of(folders)
        self._rate = float(facts["sample_rate_hz"])
        self._has_onset = "onset_hop_samples" in facts
        hello = {"type": "hello", "facts": facts, "simulated": simulated, "source": source}
        self._hello = json.dumps(hello, allow_nan=False)
        self._state, self._text = "waiting", ""
        self._shift_s = 0.0  # from the sender's clock to the stream's
        self._pending: deque[Placed | str] = deque()
        self._lock = threading.Lock()
        self._pages: set[_Page] = set()
        self._refused, self._report = Notices("refused", "connection"), report
        self._one_wrong_token = asyncio.Lock()
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(self._not_taken)
        self._started: threading.Event = threading.Event()
        self._error: OSError | None = None
        self._ending = asyncio.Event()
        self._thread = threading.Thread(target=self._run, args=(port,), daemon=True)
        self._thread.start()
        self._started.wait()
        if self._error is not None:
            reason = self._error.strerror or self._error
            raise OSError(f"cannot serve at {host}:{port}: {reason}; give another port=")

    @property
    def address(self) -> str:
        """Of the page."""
        name = socket.gethostname() if self._host in ("", "0.0.0.0", "::") else self._host
        name = f"[{name}]" if ":" in name else name
        asked = "" if self._token is None else f"?token={quote(self._token)}"
        return f"http://{name}:{self.port}/{asked}"

    # The sink, called by another thread -----------------------------------------------------------

    def samples(self, first: int, block: Block) -> None:
        """Show them soon."""
        if block.time_s is not None:
            self._shift_s = first / self._rate - float(block.time_s[0])
        if self._pages:
            with self._lock:
                self._pending.append(Placed(first, Block(block.samples.astype("<f4"))))

    def decisions(self, decisions: Decisions) -> None:
        """Show them soon."""
        if not self._pages:
            return
        columns = decision_columns(decisions, has_onset=self._has_onset)
        for name in ("time_s", "onset_s"):
            columns[name] = [t if t is None else t + self._shift_s for t in columns[name]]
        with self._lock:
            self._pending.append(json.dumps({"type": "decisions", "columns": columns}))

    def event(self, kind: str, text: str) -> None:
        """Show it at once."""
        self._state = kind if kind in _STATES else self._state
        self._text = text
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._send_state)

    def close(self) -> None:
        """Send what is left, and end."""
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._ending.set)
        self._thread.join(5 * _LAST_WORDS_S)

    # The server's thread --------------------------------------------------------------------------

    def _run(self, port: int) -> None:
        try:
            self._loop.run_until_complete(self._serve(port))
        finally:
            self._started.set()
            self._loop.close()

    async def _serve(self, port: int) -> None:
        from websockets.asyncio.server import serve

        caller = _caller_class()
        quiet = logging.Logger("page", logging.CRITICAL)  # what strangers send is no news
        try:
            server: Server = await serve(
                self._page,
                self._host,
                port,
                process_request=self._answer,
                create_connection=caller,
                backlog=_BACKLOG,
                open_timeout=_IDLE_S,
                compression=None,
                max_size=1024,
                close_timeout=_LAST_WORDS_S,
                server_header=None,
                logger=quiet,
            )
        except OSError as error:
            self._error = error
            return
        async with server:
            self.port: int = next(iter(server.sockets)).getsockname()[1]
            self._started.set()
            ticks = 0
            while not self._ending.is_set():
                await asyncio.sleep(_TICK_S)
                self._send_pending()
                ticks += 1
                if ticks % round(_STATUS_S / _TICK_S) == 0:
                    self._send_state()
            self._send_pending()
            self._send_state()
            if waits := [asyncio.ensure_future(page.empty.wait()) for page in self._pages]:
                await asyncio.wait(waits, timeout=_LAST_WORDS_S)
            caller.drop(0)  # else their requests are waited for

    def _send_pending(self) -> None:
        with self._lock:
            pending, self._pending = self._pending, deque()
        messages: list[tuple[str | bytes, int]] = []
        for item in merged(pending):  # samples stand before the decisions on them
            if isinstance(item, str):
                messages.append((item, 0))
                continue
            samples = item.block.samples
            header = struct.pack("<IId", 1, len(samples), item.first)
            messages.append((header + samples.tobytes(), len(samples)))
        for page in self._pages:
            page.offer(messages)

    def _send_state(self) -> None:
        self._send_pending()
        for page in self._pages:
            page.offer([(self._status(page.dropped), 0)])

    def _status(self, dropped_to_page: int) -> str:
        status = {"type": "status", "state": self._state}
        counts = {"received": self._counts.received, "dropped": self._counts.dropped}
        of_page = {"dropped_to_page": dropped_to_page, "text": self._text}
        return json.dumps(status | counts | of_page)

    async def _page(self, connection: ServerConnection) -> None:
        page = _Page(connection.send, round(_WAITING_S * self._rate))
        page.offer([(self._hello, 0), (self._status(0), 0)])
        sending = asyncio.ensure_future(page.send_all())
        self._pages.add(page)
        try:
            reading = asyncio.ensure_future(connection.wait_closed())
            await asyncio.wait((sending, reading), return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._pages.discard(page)
            sending.cancel()
            await connection.close()

    def _not_taken(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Say in one line what asyncio would log with a trace, such as too many open files."""
        del loop
        error = context.get("exception")
        reason = (isinstance(error, OSError) and error.strerror) or error or context["message"]
        self._refused.add(1, f"of the page failed: {reason}")
        for event in self._refused.events():
            self._report(event)

    async def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Files of the page, or a refusal; ``None`` for a socket that may open."""
        path, _, query = request.path.partition("?")
        host = request.headers.get("Host", "")
        if self._is_loopback and not _is_loopback_name(urlsplit(f"//{host}").hostname or ""):
            return _response(HTTPStatus.FORBIDDEN, b"another name than this machine's\n")
        if (method := getattr(request, "method", "GET")) not in ("GET", "HEAD"):
            return _response(HTTPStatus.METHOD_NOT_ALLOWED, b"GET or HEAD\n")
        if path == "/ws":
            return await self._refusal(request.headers.get_all("Origin"), host, query)
        if path == "/live.json":
            live = {"socket": "ws", "token_needed": self._token is not None}
            return _response(HTTPStatus.OK, json.dumps(live).encode(), ".json", host, method)
        root, file = self._files.get(unquote(path), (None, None))
        try:
            if root is None or file is None or not file.resolve().is_relative_to(root):
                raise FileNotFoundError
            content = file.read_bytes()
        except OSError:
            return _response(HTTPStatus.NOT_FOUND, b"no such file\n")
        return _response(HTTPStatus.OK, content, file.suffix, host, method)

    async def _refusal(self, origins: list[str], host: str, query: str) -> Response | None:
        """Why a socket may not open; a program that is no browser has no origin."""
        if any(origin not in (f"http://{host}", f"https://{host}") for origin in origins):
            return _response(HTTPStatus.FORBIDDEN, b"a page of another site\n")
        given = parse_qs(query).get("token", [""])[-1]
        if self._token and not hmac.compare_digest(given.encode(), self._token.encode()):
            async with self._one_wrong_token:
                await asyncio.sleep(_WRONG_TOKEN_S)
            return _response(HTTPStatus.UNAUTHORIZED, b"a wrong token or none\n")
        if len(self._pages) >= _MOST_PAGES:
            return _response(HTTPStatus.SERVICE_UNAVAILABLE, b"too many pages\n")
        return None


class _Page:
    """What waits for one page."""

    def __init__(self, send: Callable[[str | bytes], Any], most_rows: int) -> None:
        self._send, self._most_rows = send, most_rows
        self._waiting: deque[tuple[str | bytes, int]] = deque()
        self._rows = 0
        self._changed, self.empty = asyncio.Event(), asyncio.Event()
        self._is_hopeless = False
        self.dropped = 0

    def offer(self, messages: list[tuple[str | bytes, int]]) -> None:
        """Put messages behind the others, with how many samples each holds."""
        if self._rows > self._most_rows:
            self.dropped += self._rows
            self._waiting = deque(each for each in self._waiting if not each[1])
            self._rows = 0
        self._waiting.extend(messages)
        self._rows += sum(rows for _, rows in messages)
        self._is_hopeless |= len(self._waiting) > _MOST_TEXTS
        if self._waiting:
            self.empty.clear()
            self._changed.set()

    async def send_all(self) -> None:
        """Send as fast as it takes them, until it is gone or hopelessly behind."""
        from websockets.exceptions import ConnectionClosed

        try:
            while not self._is_hopeless:
                while self._waiting:
                    message, rows = self._waiting.popleft()
                    self._rows -= rows
                    await self._send(message)
                self.empty.set()
                self._changed.clear()
                await self._changed.wait()
        except ConnectionClosed:
            pass
        finally:
            self.empty.set()


def _caller_class() -> Any:
    """Connections of one server: the oldest that are no open page are closed for new ones."""
    from websockets.asyncio.server import ServerConnection
    from websockets.protocol import State

    class Caller(ServerConnection):
        made: ClassVar[list[Caller]] = []  # the oldest first

        @classmethod
        def drop(cls, most: int) -> None:
            """Close the oldest of those that are no page, until there are no more than ``most``."""
            others = [each for each in cls.made if each.state is not State.OPEN]
            for each in others[: max(0, len(others) - most)]:
                cls.made.remove(each)
                each.transport.abort()

        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            super().connection_made(transport)
            self.made.append(self)
            self.drop(_MOST_OTHERS)

        def connection_lost(self, exc: Exception | None) -> None:
            if self in self.made:
                self.made.remove(self)
            super().connection_lost(exc)

        def send_data(self) -> None:
            """All at once, and nothing to who is gone: asyncio would log a line for each."""
            parts = self.protocol.data_to_send()
            if self.transport.is_closing():
                return
            if content := b"".join(parts):
                self.transport.write(content)
            if b"" in parts:  # the end
                with suppress(OSError, RuntimeError):
                    self.transport.write_eof()

    return Caller


def _files_of(folders: Mapping[str, Path]) -> dict[str, tuple[Path, Path]]:
    """Each file that may be served with its folder, by its path in a request: no others exist."""
    files = {}
    for prefix, folder in folders.items():
        root = folder.resolve()
        for path in sorted(root.rglob("*")):
            inner = path.relative_to(root)
            if path.suffix in _TYPES and path.is_file() and "node_modules" not in inner.parts:
                files["/" + "/".join((*filter(None, (prefix,)), *inner.parts))] = root, path
    files["/"] = files["/index.html"]
    return files


def _response(
    status: HTTPStatus, content: bytes, suffix: str = "", host: str = "", method: str = "GET"
) -> Response:
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    policy = "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; style-src 'self'; "
    policy += f"connect-src 'self' ws://{host} wss://{host}; img-src 'self' data:; "
    headers = {
        "Content-Type": _TYPES.get(suffix, "text/plain; charset=utf-8"),
        "Content-Length": str(len(content)),
        "Content-Security-Policy": policy + "base-uri 'none'; form-action 'none'",
        "Cross-Origin-Opener-Policy": "same-origin",
        "Cross-Origin-Embedder-Policy": "require-corp",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Referrer-Policy": "no-referrer",  # the address has the token
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "no-cache",
        "Connection": "close",
    }
    body = b"" if method == "HEAD" else content
    return Response(status.value, status.phrase, Headers(headers), body)
