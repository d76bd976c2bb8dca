"""Viser's private names that the page leans on, all of them: held by tests/system/test_viser_private.py."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from http import HTTPStatus
from typing import Any

import viser
import websockets.asyncio.server
from viser import _messages

MESSAGES_LET_IN: tuple[type, ...] = (
    _messages.ViewerCameraMessage,
    _messages.GuiUpdateMessage,
    _messages.CommandTriggerMessage,
)
"""What a browser may say: where it looks from, a slider moved, a key pressed. Nothing else."""


def start_server(may_connect: Callable[[Any], bool]) -> viser.ViserServer:
    """Viser, on a free port of the loopback, which answers nothing but 403 to whoever may not connect.

    Viser itself lets any page in the machine's browser open its socket, and serves files over the same port.

    Args:
        may_connect: Judges by the headers of a request.
    """
    serve = websockets.asyncio.server.serve

    def guarded(*args: Any, process_request: Callable, **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            if may_connect(request.headers):
                return process_request(connection, request)
            return connection.respond(HTTPStatus.FORBIDDEN, "")

        return serve(*args, process_request=check, **options)

    websockets.asyncio.server.serve = guarded  # type: ignore[misc, assignment]
    try:  # it has called it when it is made
        return viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]


def lock_down(server: viser.ViserServer) -> None:
    """Leaves a client nothing to say to the server as a whole.

    Viser would open a public tunnel for anyone who asks, and take uploads into memory.
    """
    server._websock_server._incoming_handlers.clear()
    connect_callbacks = server._websock_server._client_connect_cb

    def restrict(connection: Any) -> None:
        handlers = connection._incoming_handlers
        for kind in [kind for kind in handlers if kind not in MESSAGES_LET_IN]:
            del handlers[kind]
        if _messages.GuiUpdateMessage in handlers:
            handlers[_messages.GuiUpdateMessage] = [
                _values_only(handler) for handler in handlers[_messages.GuiUpdateMessage]
            ]

    connect_callbacks.append(restrict)


def request_headers(server: viser.ViserServer, client_id: int) -> Any:
    """The HTTP headers a client's WebSocket was opened with; empty if it has gone."""
    connection = server._websock_server._live_connections.get(client_id)
    request = connection.request if connection is not None else None
    return request.headers if request is not None else {}


def hang_up(server: viser.ViserServer, client_id: int) -> None:
    """Closes a client's connection."""
    connection = server._websock_server._live_connections.get(client_id)
    loop = server._websock_server._background_event_loop
    if connection is not None and loop is not None:
        asyncio.run_coroutine_threadsafe(connection.close(1008, "not through the front"), loop)


def _values_only(handler: Callable) -> Callable:
    # An update may name any property of a handle; a browser has reason to send only values.
    async def checked(client_id: Any, message: Any) -> None:
        if set(message.updates) == {"value"}:
            await handler(client_id, message)

    return checked
