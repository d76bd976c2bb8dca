"""Viser's private names that the page leans on: if an update moves them, these fail first."""

from __future__ import annotations

import aiohttp
import pytest
import viser
from viser import _messages

from helpers.beside_playwright import run
from onedemo.app.http import assets
from onedemo.app.ui import app, viser_private

pytestmark = pytest.mark.seam


def test_version_is_the_one_that_was_read():
    assert viser.__version__ == "1.1.1"


def test_html_has_the_places_where_ours_goes():
    html = assets.page_html()
    assert "<title>onedemo</title>" in html and "Viser</title>" not in html
    assert html.index("static/page.js") < html.index("data-p=")


def test_nobody_can_talk_to_the_server_as_a_whole(site):
    assert site.page._server._websock_server._incoming_handlers == {}


def test_direct_connection_gets_no_page(site):
    async def go():
        async with aiohttp.ClientSession() as session:
            async with session.ws_connect(
                f"http://127.0.0.1:{site.page.port}/", protocols=[f"viser-v{viser.__version__}"]
            ) as socket:
                # A camera message is what makes Viser count a client as connected.
                await socket.send_bytes(camera_message())
                while True:
                    message = await socket.receive(timeout=5)
                    if message.type is aiohttp.WSMsgType.CLOSE:
                        return message.data
                    assert message.type is aiohttp.WSMsgType.BINARY
                    assert b"od-header" not in message.data

    assert run(go()) == 1008
    assert not site.page._sessions


def camera_message() -> bytes:
    import msgspec

    return msgspec.msgpack.encode(
        {
            "type": "ViewerCameraMessage",
            "wxyz": [1.0, 0.0, 0.0, 0.0],
            "position": [0.0, -3.0, 1.0],
            "fov": 0.8,
            "near": 0.01,
            "far": 100.0,
            "image_height": 480,
            "image_width": 640,
            "look_at": [0.0, 0.0, 1.0],
            "up_direction": [0.0, 0.0, 1.0],
        }
    )


def test_roles_get_their_tabs():
    assert [tab.title for tab in app.tabs_of("annotator")] == ["Rate", "Guide"]
    assert [tab.title for tab in app.tabs_of("annotator", compare=True)] == ["Rate", "Compare", "Guide"]
    titles = [tab.title for tab in app.tabs_of("researcher")]
    assert titles == ["Watch", "Runs", "Rate", "Compare", "Data", "Guide"]


def test_only_known_messages_are_let_in():
    assert _messages.ShareUrlRequest not in viser_private.MESSAGES_LET_IN
    assert _messages.FileTransferStartUpload not in viser_private.MESSAGES_LET_IN
