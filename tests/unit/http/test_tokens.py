"""Links: the same at every start, guessable by nobody, stored only as hashes."""

from __future__ import annotations

import stat
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
