"""The lines that ``onedemo proxy`` prints, in a real proxy, with a browser before it."""

from __future__ import annotations

import logging
import os
import re
import shutil
import socket
import subprocess
import time
from contextlib import contextmanager

import aiohttp
import pytest

from browser.test_page import DESKTOP, press_and_wait, shown_clip, until
from helpers.beside_playwright import run
from onedemo.app.cli.main import main
from onedemo.app.http import viser_proxy
from onedemo.app.http.server import Front
from onedemo.app.http.tokens import issue_link, read_secret
from onedemo.app.network.bind import Listening

pytestmark = pytest.mark.seam


def program(name):
    found = shutil.which(name, path=os.environ["PATH"] + os.pathsep + "/usr/sbin")
    if found is None:
        pytest.skip(f"there is no {name}: install the package {'nginx-light' if name == 'nginx' else name}")
    return found


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextmanager
def running(words, port, directory):
    log = directory / "proxy.log"
    with log.open("w") as out:
        process = subprocess.Popen(words, stdout=out, stderr=out, cwd=directory)
    try:
        end = time.monotonic() + 60
        while True:
            assert process.poll() is None, log.read_text()
            try:
                socket.create_connection(("127.0.0.1", port), 1).close()
                break
            except OSError:
                assert time.monotonic() < end, log.read_text()
                time.sleep(0.05)
        yield
    finally:
        process.terminate()
        process.wait(timeout=30)


@contextmanager
def behind_nginx(lines, directory):
    nginx, port = program("nginx"), free_port()
    words = ["req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=localhost"]
    subprocess.run(["openssl", *words, "-keyout", "k.pem", "-out", "c.pem"], cwd=directory, check=True,
                   capture_output=True)  # fmt: skip
    lines = lines.replace("listen 443 ssl", f"listen 127.0.0.1:{port} ssl")
    lines = re.sub(r"(ssl_certificate\s+)\S+;", rf"\1{directory}/c.pem;", lines)
    lines = re.sub(r"(ssl_certificate_key\s+)\S+;", rf"\1{directory}/k.pem;", lines)
    kept = "".join(
        f"{kind}_temp_path {directory}/{kind};"
        for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    text = (
        f"daemon off; pid {directory}/pid; error_log stderr; worker_processes 1; events {{}}\n"
        f"http {{ access_log off; {kept}\n{lines}\n}}"
    )
    (directory / "nginx.conf").write_text(text)
    with running([nginx, "-p", directory, "-c", directory / "nginx.conf"], port, directory):
        yield f"https://localhost:{port}"


@contextmanager
def behind_caddy(lines, directory):
    caddy, port = program("caddy"), free_port()
    lines = lines.replace("localhost {", f"http://localhost:{port} {{")
    (directory / "Caddyfile").write_text("{\n admin off\n}\n" + lines)
    with running([caddy, "run", "--adapter", "caddyfile", "--config", "Caddyfile"], port, directory):
        yield f"http://localhost:{port}"


@contextmanager
def served(site, base_path):
    front = Front(site.page, Listening(port=0, behind_proxy=True, names=("localhost",), base_path=base_path))
    front.start()
    try:
        yield front.port
    finally:
        front.close()


def lines_for(kind, port, base_path, capsys):
    words = ["proxy", kind, "--host-name", "localhost", "--port", str(port)]
    assert main([*words, *(["--base-path", base_path] if base_path else [])]) == 0
    return capsys.readouterr().out


def link(site, url):
    """Another link for the annotator, by this address."""
    store = site.trainer.store
    return issue_link(store, read_secret(store.path.parent), store.accounts.ensure("bo", "annotator"), url)


@pytest.mark.parametrize(
    ("behind", "kind", "base_path"),
    [(behind_nginx, "nginx", "/study1"), (behind_caddy, "caddy", "")],
)
def test_the_page_works_behind_a_proxy(chromium, site, tmp_path, capsys, behind, kind, base_path):
    with served(site, base_path) as port, behind(lines_for(kind, port, base_path, capsys), tmp_path) as url:
        context = chromium.new_context(viewport=DESKTOP, ignore_https_errors=True)
        page, asked = context.new_page(), []
        context.on("response", lambda answer: asked.append((answer.status, answer.url)))
        page.goto(link(site, url + base_path))
        page.wait_for_selector(".od-header", timeout=60_000)
        page.wait_for_url(f"{url}{base_path}/r/2/rate")
        shown_clip(page)
        assert press_and_wait(page, site, lambda: page.keyboard.press("4"))[2] == 4
        for short in (base_path, base_path + "/"):
            assert page.request.get(url + short).url == f"{url}{base_path}/r/2/"
        cookies = {cookie["path"]: cookie for cookie in context.cookies() if cookie["httpOnly"]}
        assert set(cookies) == {f"{base_path}/r/2", f"{base_path}/"}
        assert all(cookie["secure"] == (kind == "nginx") for cookie in cookies.values())
        page.click(".od-account")
        page.click("text=Sign out")
        page.wait_for_selector("text=You are signed out")
        assert page.url == f"{url}{base_path}/signed-out"
        context.close()
    assert [answer for answer in asked if answer[0] >= 400] == []
    assert all(address.startswith((url + base_path, "data:", "blob:")) for _, address in asked)


def test_a_proxy_that_does_not_pass_on_what_it_must_is_named_in_the_log(
    site, tmp_path, capsys, caplog, monkeypatch
):
    monkeypatch.setattr(viser_proxy, "_FOLLOWED_S", 0.2)
    caplog.set_level(logging.WARNING, "onedemo.page")

    async def open_page(url):
        async with aiohttp.ClientSession(connector=aiohttp.TCPConnector(ssl=False)) as session:
            async with session.get(link(site, url)) as page:
                assert page.status == 200
            with pytest.raises(aiohttp.WSServerHandshakeError):
                await session.ws_connect(f"{url}/r/2/", headers={"Origin": url})

    with served(site, "") as port:
        lines = lines_for("nginx", port, "", capsys)
        for left_out, said in (("Host", "was refused its connection"), ("Upgrade", "did not come within")):
            assert said not in caplog.text
            (directory := tmp_path / left_out).mkdir()
            with behind_nginx(re.sub(rf".*proxy_set_header {left_out} .*\n", "", lines), directory) as url:
                run(open_page(url))
                until(lambda said=said: said in caplog.text, 60)
            caplog.clear()
