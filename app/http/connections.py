"""Connections of the front: who may hold how many, for how long, and how much may come over one.

Whoever has shown no session is a stranger. Strangers share a fixed number of places; when those are full,
the oldest connection of the address that holds most of them ends. So a newcomer always gets one, and keeps it
long enough to show a session: from then on the connection counts as that person's, whom strangers cannot
crowd out. All places together are fewer than the file descriptors of the process.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
import ssl
from collections.abc import Hashable
from contextlib import suppress
from dataclasses import dataclass
from typing import Generic, TypeVar

from aiohttp import web

from onedemo.app.http.bind import network
from onedemo.app.http.rate_limit import Bucket

log = logging.getLogger("onedemo.page")

STRANGER_S = 30.0
"""How long a connection without a session lasts, from its start or its last complete header."""
KEEP_ALIVE_S = 75.0
"""How long one with a session may wait for its next request."""
STALLED_S = 30.0
"""How long what was sent may go untaken."""
HANDSHAKE_S = 10.0
_LOOK_S = 1.0
_WANTED_DESCRIPTORS = 16_384
_WAITING = 512
"""Connections that the system holds until they are accepted."""
_NONE_LEFT = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)

Item = TypeVar("Item", bound=Hashable)


@dataclass(frozen=True, kw_only=True)
class Limits:
    """How many connections there may be."""

    strangers: int
    """Without a session."""
    strangers_each: int
    """Of one address."""
    members: int
    """With a session."""
    members_each: int
    """Of one person."""
    pages: int
    """Open pages. Each has a connection of a member, and two more descriptors towards Viser."""

    @classmethod
    def of(cls, descriptors: int, *, addresses_known: bool = True) -> Limits:
        """What a process with so many file descriptors can afford: a third is left for everything else.

        Args:
            descriptors: As ``raise_descriptors`` gives it.
            addresses_known: Whether connections come from the people themselves, not from one proxy.
        """
        strangers = min(512, descriptors // 8)
        return cls(
            strangers=strangers,
            strangers_each=min(64, strangers // 2) if addresses_known else strangers,
            members=min(2048, descriptors // 4),
            members_each=64,
            pages=min(300, descriptors // 8),
        )


def raise_descriptors() -> int:
    """Lets the process have as many file descriptors as it may (up to 16,384); returns how many."""
    try:
        import resource
    except ImportError:  # Windows has no such limit; select() there takes 512
        return 512
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    unlimited = resource.RLIM_INFINITY
    wanted = _WANTED_DESCRIPTORS if hard == unlimited else min(hard, _WANTED_DESCRIPTORS)
    if soft != unlimited and soft < wanted:
        with suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    soft = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return _WANTED_DESCRIPTORS if soft == unlimited else soft


class Crowd(Generic[Item]):
    """Items by whose they are: so many in all, so many of each. Whoever comes is let in; another leaves.

    Args:
        most: In all.
        most_each: Of one.
    """

    def __init__(self, most: int, most_each: int) -> None:
        self._most, self._most_each = most, most_each
        self._of: dict[Hashable, dict[Item, None]] = {}
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def __contains__(self, item: tuple[Hashable, Item]) -> bool:
        return item[1] in self._of.get(item[0], ())

    def enter(self, whose: Hashable, item: Item) -> Item | None:
        """Lets an item in, as the newest; returns the one that has to leave for it, if any."""
        self.leave(whose, item)
        out = None
        if len(self._of.get(whose, ())) >= self._most_each:
            out = self._oldest(whose)
        elif self._count >= self._most:
            out = self._oldest(max(self._of, key=lambda one: len(self._of[one])))
        self._of.setdefault(whose, {})[item] = None
        self._count += 1
        return out

    def leave(self, whose: Hashable, item: Item) -> None:
        """Takes an item out, if it is in."""
        of = self._of.get(whose, {})
        if item in of:
            del of[item]
            self._count -= 1
            if not of:
                del self._of[whose]

    def _oldest(self, whose: Hashable) -> Item:
        item = next(iter(self._of[whose]))
        self.leave(whose, item)
        return item


class Connection(web.RequestHandler):
    """One connection, from its acceptance to its end.

    Args:
        held: All connections.
        server: Whose requests come over it.
        wire: The socket.
        address: Where it comes from.
    """

    def __init__(self, held: Connections, server: web.Server, wire: socket.socket, address: str) -> None:
        loop = asyncio.get_running_loop()
        super().__init__(
            server,
            loop=loop,
            keepalive_timeout=KEEP_ALIVE_S,
            access_log=None,  # type: ignore[arg-type]
            auto_decompress=False,  # nothing is inflated: see ``onedemo.app.http.refusals``
            lingering_time=2.0,
        )
        self._held, self._wire, self._clock = held, wire, loop.time
        self._carrier: asyncio.Transport | None = None
        self._allowed: Bucket | None = None
        self._untaken, self._untaken_since = 0, 0.0
        self.whose: Hashable = address
        """The address, or the person's number once it is known."""
        self.stranger = True
        self.heard_at = loop.time()

    def heard(self) -> None:
        """A whole header has come."""
        if self.stranger:
            self.heard_at = self._clock()

    def belongs_to(self, person: int) -> None:
        """Its request has shown a session of this person."""
        if self.stranger or self.whose != person:
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

    def connection_lost(self, exc: BaseException | None) -> None:
        """It has ended."""
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
            response = web.Response(status=status, text="This is no request that can be understood.")
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
        self._strangers: Crowd[Connection] = Crowd(limits.strangers, limits.strangers_each)
        self._members: Crowd[Connection] = Crowd(limits.members, limits.members_each)
        self._all: set[Connection] = set()
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
        loop = asyncio.get_running_loop()
        # asyncio knows how to bind a name that stands for several addresses; it does not accept for us,
        # since it knows no limit and, out of descriptors, fills the log.
        bound = await loop.create_server(asyncio.Protocol, host, port, start_serving=False)
        self._listeners = [each.dup() for each in bound.sockets]
        bound.close()
        for listener in self._listeners:
            listener.setblocking(False)
            listener.listen(_WAITING)
            self._keep(self._accept(listener, server, tls))
        self._keep(self._end_overdue())
        return self._listeners[0].getsockname()[1]

    async def close(self) -> None:
        """Accepts nothing any more."""
        for task in (tasks := list(self._tasks)):
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for listener in self._listeners:
            listener.close()

    def move(self, connection: Connection, person: int) -> None:
        """A connection turns out to be this person's."""
        self._crowd(connection).leave(connection.whose, connection)
        connection.whose, connection.stranger = person, False
        self._enter(connection)

    def leave(self, connection: Connection) -> None:
        """A connection has ended."""
        self._all.discard(connection)
        self._crowd(connection).leave(connection.whose, connection)

    def _enter(self, connection: Connection) -> None:
        out = self._crowd(connection).enter(connection.whose, connection)
        if out is not None:
            out.end()

    def _crowd(self, connection: Connection) -> Crowd[Connection]:
        return self._strangers if connection.stranger else self._members

    def _keep(self, coroutine) -> None:
        task = asyncio.get_running_loop().create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _accept(self, listener: socket.socket, server: web.Server, tls: ssl.SSLContext | None) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                wire, address = await loop.sock_accept(listener)
            except OSError as error:
                if error.errno in _NONE_LEFT:
                    log.error("no connection can be accepted: %s", error.strerror)
                    await asyncio.sleep(0.2)
                continue
            wire.setblocking(False)
            place = network(address[0]) if self._addresses_known else ""
            connection = Connection(self, server, wire, place)
            self._all.add(connection)
            self._enter(connection)
            self._keep(self._join(connection, wire, tls))

    async def _join(self, connection: Connection, wire: socket.socket, tls: ssl.SSLContext | None) -> None:
        loop = asyncio.get_running_loop()
        timeouts = {} if tls is None else {"ssl_handshake_timeout": HANDSHAKE_S, "ssl_shutdown_timeout": 2.0}
        try:
            await loop.connect_accepted_socket(lambda: connection, wire, ssl=tls, **timeouts)
        except (OSError, TimeoutError):  # left, or speaks no TLS
            wire.close()
            self.leave(connection)
        except BaseException:
            wire.close()
            self.leave(connection)
            raise

    async def _end_overdue(self) -> None:
        while True:
            await asyncio.sleep(_LOOK_S)
            now = asyncio.get_running_loop().time()
            for connection in tuple(self._all):
                if connection.overdue(now):
                    connection.end()
