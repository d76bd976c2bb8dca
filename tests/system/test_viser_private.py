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


def test_our_scripts_run_before_viser_s_client_which_is_packed_as_it_was():
    html = assets.page_html()
    assert html.index("static/page.js") < html.index("static/viser/viser.js")
    assert assets.viser_files()["zstd.wasm"].kind == "application/wasm"


def test_nobody_can_talk_to_the_server_as_a_whole(site):
    assert site.page._server._websock_server._incoming_handlers == {}


@pytest.mark.parametrize("origin", [None, "http://evil.example", "own"])
def test_whoever_does_not_come_through_the_front_gets_nothing(site, origin):
    """Neither a socket nor a file: any page in a browser of this machine can reach the port."""
    url = f"http://127.0.0.1:{site.page.port}/"
    headers = {} if origin is None else {"Origin": url[:-1] if origin == "own" else origin}

    async def go():
        async with aiohttp.ClientSession() as session:
            with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                await session.ws_connect(url, protocols=[f"viser-v{viser.__version__}"], headers=headers)
            async with session.get(url, headers=headers) as answer:
                return refused.value.status, answer.status, await answer.read()

    assert run(go()) == (403, 403, b"")
    assert not site.page._sessions


def test_roles_get_their_tabs():
    assert [tab.title for tab in app.tabs_of("annotator")] == ["Rate", "Guide"]
    assert [tab.title for tab in app.tabs_of("annotator", compare=True)] == ["Rate", "Compare", "Guide"]
    titles = [tab.title for tab in app.tabs_of("researcher")]
    assert titles == ["Start", "Watch", "Runs", "Rate", "Compare", "Data", "Guide"]


def test_only_known_messages_are_let_in():
    assert _messages.ShareUrlRequest not in viser_private.MESSAGES_LET_IN
    assert _messages.FileTransferStartUpload not in viser_private.MESSAGES_LET_IN
