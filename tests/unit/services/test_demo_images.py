"""Pictures of a demo whose video is gone: said once, answered shortly."""

import logging
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from aiohttp import web

from helpers.beside_playwright import run
from onedemo.app.http.media import Files
from onedemo.app.services.demo_images import Pictures
from onedemo.app.templates import render
from onedemo.demos.library import find_demo
from onedemo.types import Status


def test_a_video_that_is_gone_leaves_one_line_in_the_log(tmp_path, caplog):
    """Pages ask for hundreds of pictures; each left a traceback of 30 lines."""
    demo = replace(find_demo("hopper-hop", Path("nowhere")), path=tmp_path / "gone" / "video.webm")
    files = Files(SimpleNamespace(pictures=Pictures(demo)))
    asked = SimpleNamespace(match_info={"index": "3", "name": "axa"})

    async def ask():
        for handler in [files.demo_frame, files.demo_example] * 50:
            with pytest.raises(web.HTTPNotFound, match="Not Found"):
                await handler(asked)

    with caplog.at_level(logging.INFO):
        run(ask())
    assert len(caplog.records) == 1 and "is missing or damaged" in caplog.text
    assert len(caplog.text) < 500


def test_the_page_says_that_it_is_gone():
    status = Status(phase="online", message="")
    assert "demonstration kick is gone" in render("session.html:banner", status=status, lost="kick")
    assert "gone" not in render("session.html:banner", status=status, lost="")
