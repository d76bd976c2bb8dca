"""A real server to measure: ``onedemo serve`` as a child process, its database, clips and people."""

from __future__ import annotations

import asyncio
import hashlib
import json
import os
import re
import secrets
import sqlite3
import subprocess
import sys
import urllib.request
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

from trainer.bench.annotators import Press
from trainer.store import FILE_NAME, NewClip, Store


class Server:
    """``onedemo serve`` on a data directory, until ``close``.

    Args:
        data_dir: Of the product.
        settings: ``section.key=value``, as ``--set`` takes them, for a new run; none to go on with the
            newest run, or to make one with the defaults.

    Raises:
        RuntimeError: If it does not print its links.
    """

    def __init__(self, data_dir: Path, settings: Sequence[str] = ()) -> None:
        self.data_dir = data_dir
        self._log = data_dir.with_name(f"{data_dir.name}.err").open("w+")
        # By name: what is measured stands above this package, which imports nothing of it.
        command = [sys.executable, "-m", "app.cli", "serve", "--data-dir", str(data_dir), "--port", "0"]
        command += ["--shared", "0", "--repeated", "0"]  # each press is a rating of another clip
        command += [word for setting in settings for word in ("--set", setting)]
        command += ["--new-run"] if settings else []
        self._child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=self._log, text=True)
        assert self._child.stdout is not None
        lines = [self._child.stdout.readline() for _ in range(2)]
        self.links = dict(line.strip().split(": ", 1) for line in lines if line)
        """Of the researcher and the annotator, by role."""
        if len(self.links) != 2:
            said = Path(self._log.name).read_text().strip()
            self.close()
            raise RuntimeError(f"onedemo serve did not start: {said}")
        with closing(Store(data_dir)) as store:  # nobody practises here
            for rater in store.raters():
                store.set_practised(rater.id)

    @property
    def base(self) -> str:
        """Address of its front."""
        return self.links["annotator"].split("/login")[0]

    def phase(self) -> str:
        """What the trainer does: "pretrain", "online", "paused", ..."""
        with urllib.request.urlopen(f"{self.base}/healthz", timeout=10) as answer:
            return json.load(answer)["phase"]

    def peak_mib(self) -> float:
        """The most memory the process has had at once, MiB (Linux)."""
        status = Path(f"/proc/{self._child.pid}/status").read_text()
        found = re.search(r"VmHWM:\s+(\d+) kB", status)
        assert found is not None, "the kernel tells no peak"
        return int(found[1]) / 1024

    def rows(self, sql: str, *values: object) -> list[tuple]:
        """What its database answers, on a read-only connection of our own."""
        uri = f"{(self.data_dir / FILE_NAME).absolute().as_uri()}?mode=ro"
        with closing(sqlite3.connect(uri, uri=True, timeout=10)) as db:
            return db.execute(sql, values).fetchall()

    def close(self) -> None:
        """Ends the process as ``kill`` would; by force if it takes half a minute."""
        self._child.terminate()
        try:
            self._child.wait(30)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        assert self._child.stdout is not None
        self._child.stdout.close()
        self._log.close()


@contextmanager
def serving(data_dir: Path, settings: Sequence[str] = ()) -> Iterator[Server]:
    """A server for as long as the block lasts."""
    server = Server(data_dir, settings)
    try:
        yield server
    finally:
        server.close()


class Supply:
    """Clips that wait to be rated: drawn ones once more, under numbers of their own.

    Drawing takes part of a second of a core for each clip, so many people would wait for pictures and
    not for the page.

    Args:
        store: Of the server's data directory.
        run: The run that is served; drawn clips of it must wait.
        count: How many clips to make.
    """

    def __init__(self, store: Store, run: str, count: int) -> None:
        self._store, self._run = store, run
        drawn = store.waiting_clips(self._run)
        pictures = store.path.parent / "runs" / self._run / "clips"
        segments = {clip.id: store.segment(clip.id) for clip in drawn}
        originals = [drawn[n % len(drawn)] for n in range(count)]
        new = [
            NewClip(demo_step=clip.demo_step, segment=segments[clip.id], stage="online", iteration=1)
            for clip in originals
        ]
        self._left = [clip.id for clip in store.add_clips(self._run, new)]
        for clip, original in zip(self._left, originals, strict=True):
            os.link(pictures / f"{original.id:06d}.jpg", pictures / f"{clip:06d}.jpg")

    def fill(self, queue: int) -> None:
        """Lets so many clips wait to be rated.

        Raises:
            RuntimeError: If there are no more.
        """
        missing = max(0, queue - len(self._store.waiting_clips(self._run)))
        if missing > len(self._left):
            raise RuntimeError("more clips were rated than were made")
        self._store.set_clip_state(self._left[:missing], "ready")
        del self._left[:missing]

    async def keep(self, queue: int) -> None:
        """Fills once a second until cancelled."""
        while True:
            await asyncio.to_thread(self.fill, queue)
            await asyncio.sleep(1.0)


def annotator_link(server: Server, store: Store, name: str) -> str:
    """A link for an annotator of that name, as good as one that ``onedemo rater add`` prints."""
    token = secrets.token_urlsafe(32)
    rater = store.ensure_rater(name, "annotator")
    store.set_practised(rater.id)
    store.add_token(hashlib.sha256(token.encode()).hexdigest(), rater.id, "link")
    return f"{server.base}/login?token={token}"


def check_counts(server: Server, presses: Sequence[Press], *, after: int = 0) -> None:
    """Sees that each press is one rating in the database, and that there is no other.

    Args:
        server: Whose database.
        presses: All that were made since.
        after: The last event before them.

    Raises:
        RuntimeError: If a rating was lost, doubled or changed.
    """
    pressed = Counter((press.clip, press.value) for press in presses)
    events = Counter(server.rows("SELECT clip_id, value FROM events WHERE id > ?", after))
    if pressed != events:
        raise RuntimeError(
            f"{pressed.total()} presses became {events.total()} events: "
            f"lost {dict(pressed - events)}, too many {dict(events - pressed)}"
        )
