"""Links: the same at every start, guessable by nobody, stored only as hashes."""

from __future__ import annotations

import stat
import subprocess
import sys
import threading

import pytest

from onedemo.app.http.tokens import hash_token, issue_link, link_token, new_session_token, read_secret
from onedemo.errors import UserError
from onedemo.storage.store import Store
from onedemo.types import Rater

ADA = Rater(id=1, name="ada", role="researcher")
BO = Rater(id=2, name="bo", role="annotator")


def test_secret_is_made_once_and_only_its_owner_can_read_it(tmp_path):
    secret = read_secret(tmp_path)
    assert len(secret) == 32
    assert read_secret(tmp_path) == secret
    assert stat.S_IMODE((tmp_path / "link-secret").stat().st_mode) == 0o600
    assert [p.name for p in tmp_path.iterdir()] == ["link-secret"]


def test_processes_that_start_at_once_agree_on_the_secret(tmp_path):
    secrets = []
    threads = [threading.Thread(target=lambda: secrets.append(read_secret(tmp_path))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(secrets)) == 1


WITHOUT_LINKS = """
import ctypes, os, struct, sys
from pathlib import Path
from onedemo.app.http.tokens import read_secret
# What the kernel says on exFAT: a filter makes link(2) and linkat(2) fail with EPERM, for this process.
NUMBERS = {"x86_64": (86, 265), "aarch64": (37, 37)}[os.uname().machine]
LOAD, EQUAL, RETURN, PASS, REFUSE = 0x20, 0x15, 0x06, 0x7FFF0000, 0x00050001
steps = [(LOAD, 0, 0, 0), *((EQUAL, 2 - k, 0, n) for k, n in enumerate(NUMBERS)), (RETURN, 0, 0, PASS),
         (RETURN, 0, 0, REFUSE)]
code = b"".join(struct.pack("HBBI", *step) for step in steps)
buffer = ctypes.create_string_buffer(code)
program = struct.pack("HxxxxxxP", len(steps), ctypes.addressof(buffer))
libc = ctypes.CDLL(None, use_errno=True)
if libc.prctl(38, 1, 0, 0, 0) or libc.prctl(22, 2, program, 0, 0):
    sys.exit(77)
try:
    os.link(__file__ if "__file__" in globals() else sys.executable, sys.argv[1] + "/x")
except PermissionError:
    print(len(read_secret(Path(sys.argv[1]))))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="a filter of Linux's system calls")
def test_the_secret_needs_no_hard_links(tmp_path):
    command = [sys.executable, "-c", WITHOUT_LINKS, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode == 77:
        pytest.skip("system calls cannot be filtered here")
    assert done.stdout == "32\n", done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["link-secret"]


def test_damaged_secret_is_one_clear_sentence(tmp_path):
    (tmp_path / "link-secret").write_bytes(b"short")
    with pytest.raises(UserError, match="should be 32 bytes long, it has 5"):
        read_secret(tmp_path)


def test_tokens_depend_on_secret_and_rater_and_nothing_else():
    one = link_token(b"a" * 32, ADA)
    assert one == link_token(b"a" * 32, ADA)
    assert len({one, link_token(b"a" * 32, BO), link_token(b"b" * 32, ADA)}) == 3
    assert len(one) == 43
    assert new_session_token() != new_session_token()


def test_only_the_hash_of_a_link_is_stored(tmp_path):
    store = Store(tmp_path)
    ada = store.accounts.ensure("ada", "researcher")
    link = issue_link(store, read_secret(tmp_path), ada, "http://127.0.0.1:8080/")
    token = link.removeprefix("http://127.0.0.1:8080/login?token=")
    assert store.accounts.rater_of(hash_token(token), "link") == ada
    assert store.accounts.rater_of(hash_token(token), "session") is None
    store.close()
    everything = b"".join(p.read_bytes() for p in tmp_path.iterdir() if p.name.startswith("onedemo"))
    assert token.encode() not in everything
