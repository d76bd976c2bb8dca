"""Connections of the front: in which order they get in, how long they last, how much may come over one.

Whoever comes waits in a lobby, which costs a socket and nothing else, until a whole header has come. Then the
connection is aiohttp's, and, until its request has shown a session, a stranger's. Lobby and strangers have
fixed numbers of places; when those are taken, the oldest connection of the address that holds most of them
ends. So a newcomer always gets in. One that shows a session counts as that person's from then on, whom
strangers cannot crowd out. How many places there are, fewer in all than the file descriptors of the process,
is in ``onedemo.app.network.capacity``.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import re
import socket
import ssl
from collections.abc import Coroutine, Hashable
from contextlib import suppress

from aiohttp import web

from onedemo.app.network.bind import network
from onedemo.app.network.capacity import Crowd, Limits
from onedemo.app.network.rate_limit import Bucket

log = logging.getLogger("onedemo.page")

HEADER_S = 10.0
"""Until a whole header has come."""
STRANGER_S = 30.0
"""How long a connection without a session lasts, from its start or its last complete header."""
KEEP_ALIVE_S = 75.0
"""How long one with a session may wait for its next request."""
STALLED_S = 30.0
"""How long what was sent may go untaken."""
HANDSHAKE_S = 10.0
NOT_UNDERSTOOD = "This is no request that can be understood."
_LOOK_S = 1.0
_WAITING = 1024
"""Connections that the system holds until they are accepted."""
_ACCEPTED_AT_ONCE = 64
_LARGEST_HEADER = 1 << 15
"""Bytes; aiohttp refuses it, and says so."""
_NO_REQUEST = re.compile(rb"(?![A-Z]{1,20} \S+ HTTP/1\.[01]\r?\n)[^\n]*\n")
"""A first line that no header can follow."""
_NONE_LEFT = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)


class _Visitor:
    """Somebody in the lobby."""

    __slots__ = ("address", "head", "since", "wire")

    def __init__(self, wire: socket.socket, address: str, since: float) -> None:
        self.wire, self.address, self.since = wire, address, since
        self.head = bytearray()


class Connection(web.RequestHandler):
    """One connection, from its first header to its end.

    Args:
        held: All connections.
        server: Whose requests come over it.
        wire: The socket.
        address: Where it comes from.
        head: What has come already.
    """

    def __init__(
        self, held: Connections, server: web.Server, wire: socket.socket, address: str, head: bytes
    ) -> None:
        loop = asyncio.get_running_loop()
        super().__init__(
            server,
            loop=loop,
            keepalive_timeout=KEEP_ALIVE_S,
            access_log=None,  # type: ignore[arg-type]
            auto_decompress=False,  # nothing is inflated: see ``onedemo.app.network.refusals``
            lingering_time=2.0,
        )
        self._held, self._wire, self._clock, self._head = held, wire, loop.time, head
        self._carrier: asyncio.Transport | None = None
        self._allowed: Bucket | None = None
        self._untaken, self._untaken_since = 0, 0.0
        self.whose: Hashable = address
        """The address, or the person's number once it is known."""
        self.stranger = True
        self._gone = False
        self.heard_at = loop.time()

    def heard(self) -> None:
        """A whole header has come."""
        if self.stranger and not self._gone:
            self.heard_at = self._clock()
            self._held.enter(self)

    def belongs_to(self, person: int) -> None:
        """Its request has shown a session of this person."""
        if not self._gone and (self.stranger or self.whose != person):
            self._held.move(self, person)

    def allow(self, bucket: Bucket) -> None:
        """From now on so many bytes may come; whatever they are, more of them end the connection."""
        self._allowed = bucket

    def end(self) -> None:
        """Ends it at once, whatever is under way."""
        if self._carrier is not None:
            self._carrier.abort()
        else:  # TLS is still being agreed on
            with suppress(OSError):
                self._wire.shutdown(socket.SHUT_RDWR)

    def overdue(self, now: float) -> bool:
        """Whether it has to end; to be asked every second.

        Args:
            now: Of the loop's clock.
        """
        untaken = self._carrier.get_write_buffer_size() if self._carrier is not None else 0
        if untaken == 0 or untaken != self._untaken:
            self._untaken, self._untaken_since = untaken, now
        late = self.stranger and now - self.heard_at > STRANGER_S
        return late or now - self._untaken_since > STALLED_S

    # What asyncio and aiohttp call

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """It is open."""
        assert isinstance(transport, asyncio.Transport)
        self._carrier = transport
        super().connection_made(transport)
        head, self._head = self._head, b""
        if head:
            self.data_received(head)

    def connection_lost(self, exc: BaseException | None) -> None:
        """It has ended."""
        self._gone = True  # its request may still be answered
        self._held.leave(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Something has come."""
        if self._allowed is not None and not self._allowed.take(len(data)):
            self.end()
            return
        super().data_received(data)

    def handle_error(
        self,
        request: web.BaseRequest,
        status: int = 500,
        exc: BaseException | None = None,
        message: str | None = None,
    ) -> web.StreamResponse:
        """Answers what is no request; a stranger's doing, so neither logged nor repeated to anybody."""
        if status >= 500:
            response = super().handle_error(request, status, exc, message)
        else:
            response = web.Response(status=status, text=NOT_UNDERSTOOD)
            response.force_close()
        response.headers["Server"] = "onedemo"  # else aiohttp tells its version
        return response


class Connections:
    """Accepts connections and looks after them.

    Args:
        limits: How many there may be.
        addresses_known: Whether connections come from the people themselves, not from one proxy.
    """

    def __init__(self, limits: Limits, *, addresses_known: bool = True) -> None:
        self._addresses_known = addresses_known
        self._lobby: Crowd[_Visitor] = Crowd(limits.strangers, limits.strangers_each)
        self._strangers: Crowd[Connection] = Crowd(limits.strangers, limits.strangers_each)
        self._members: Crowd[Connection] = Crowd(limits.members, limits.members_each)
        self._listeners: list[socket.socket] = []
        self._tasks: set[asyncio.Task[None]] = set()

    async def open(self, server: web.Server, host: str, port: int, tls: ssl.SSLContext | None) -> int:
        """Listens; returns the port.

        Args:
            server: Gets the requests.
            host: Address or name; "" for all.
            port: 0 takes a free one.
            tls: What encrypts; None if nothing does.

        Raises:
            OSError: If the port cannot be opened.
        """
        self._loop, self._server, self._tls = asyncio.get_running_loop(), server, tls
        # asyncio knows how to bind a name that stands for several addresses. It does not accept for us: it
        # knows no limit and, out of descriptors, fills the log.
        bound = await self._loop.create_server(asyncio.Protocol, host or None, port, start_serving=False)
        self._listeners = [each.dup() for each in bound.sockets]
        bound.close()
        for listener in self._listeners:
            listener.setblocking(False)
            listener.listen(_WAITING)
            self._loop.add_reader(listener, self._accept, listener)
        self._keep(self._end_overdue())
        return self._listeners[0].getsockname()[1]

    async def close(self) -> None:
        """Accepts nothing any more, and sends those in the lobby away."""
        for task in (tasks := list(self._tasks)):
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for visitor in self._lobby:
            self._send_away(visitor)
        for listener in self._listeners:
            self._loop.remove_reader(listener)
            listener.close()

    def enter(self, connection: Connection) -> None:
        """A connection takes the newest place among those of its kind."""
        out = self._crowd(connection).enter(connection.whose, connection)
        if out is not None:
            out.end()

    def move(self, connection: Connection, person: int) -> None:
        """A connection turns out to be this person's."""
        self.leave(connection)
        connection.whose, connection.stranger = person, False
        self.enter(connection)

    def leave(self, connection: Connection) -> None:
        """A connection has ended."""
        self._crowd(connection).leave(connection.whose, connection)

    def _crowd(self, connection: Connection) -> Crowd[Connection]:
        return self._strangers if connection.stranger else self._members

    # The lobby

    def _accept(self, listener: socket.socket) -> None:
        for _ in range(_ACCEPTED_AT_ONCE):
            try:
                wire, address = listener.accept()
            except OSError as error:
                if error.errno in _NONE_LEFT:
                    log.error("no connection can be accepted: %s", error.strerror)
                    self._loop.remove_reader(listener)
                    self._loop.call_later(_LOOK_S, self._accept_again, listener)
                return
            wire.setblocking(False)
            place = network(address[0]) if self._addresses_known else ""
            visitor = _Visitor(wire, place, self._loop.time())
            out = self._lobby.enter(place, visitor)
            if out is not None:
                self._send_away(out)
            self._loop.add_reader(wire, self._hear, visitor)
            self._hear(visitor)  # mostly it has spoken already

    def _accept_again(self, listener: socket.socket) -> None:
        if listener.fileno() >= 0:
            self._loop.add_reader(listener, self._accept, listener)

    def _hear(self, visitor: _Visitor) -> None:
        try:
            said = visitor.wire.recv(1, socket.MSG_PEEK) if self._tls else visitor.wire.recv(1 << 14)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:
            said = b""
        if not said:
            self._send_away(visitor)
            return
        head = visitor.head
        if not self._tls:
            head += said
            whole = b"\r\n\r\n" in head or len(head) > _LARGEST_HEADER or _NO_REQUEST.match(head)
            if not whole:
                return
        self._loop.remove_reader(visitor.wire)
        self._lobby.leave(visitor.address, visitor)
        connection = Connection(self, self._server, visitor.wire, visitor.address, bytes(head))
        self.enter(connection)
        self._keep(self._join(connection, visitor.wire))

    def _send_away(self, visitor: _Visitor) -> None:
        self._lobby.leave(visitor.address, visitor)
        self._loop.remove_reader(visitor.wire)
        visitor.wire.close()

    # Tasks

    def _keep(self, coroutine: Coroutine[None, None, None]) -> None:
        task = self._loop.create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _join(self, connection: Connection, wire: socket.socket) -> None:
        timeouts = {"ssl_handshake_timeout": HANDSHAKE_S, "ssl_shutdown_timeout": 2.0} if self._tls else {}
        try:
            await self._loop.connect_accepted_socket(lambda: connection, wire, ssl=self._tls, **timeouts)
        except BaseException as error:
            wire.close()
            self.leave(connection)
            if not isinstance(error, (OSError, TimeoutError)):  # left, or speaks no TLS
                raise

    async def _end_overdue(self) -> None:
        while True:
            await asyncio.sleep(_LOOK_S)
            now = self._loop.time()
            for visitor in self._lobby:
                if now - visitor.since > HEADER_S:
                    self._send_away(visitor)
            for connection in (*self._strangers, *self._members):
                if connection.overdue(now):
                    connection.end()
