"""Puts the web app together: store, trainer thread, page, front; and takes it apart in order."""

from __future__ import annotations

import signal
import sys
import threading
from pathlib import Path

from onedemo.app.annotation.assignment import Again
from onedemo.app.http.server import Front
from onedemo.app.http.tokens import issue_link, read_secret, write_address
from onedemo.app.network.bind import Listening
from onedemo.app.services.run_manager import Study
from onedemo.app.ui.app import Page
from onedemo.config import RunConfig
from onedemo.core.log_limit import limit_logs
from onedemo.core.process import end_within
from onedemo.render.drawing_process import DrawingProcess
from onedemo.robots import registry
from onedemo.storage.store import Store
from onedemo.training.runs import add_run, find_run
from onedemo.types import Demo
from onedemo.vision.encoders import make_encoder

_SWITCH_SECONDS = 0.0005
"""A press passes through five threads. Each would wait Python's usual 5 ms for a trainer that computes."""
_END_SECONDS = 8.0
"""What ends in good order is given that time; the rest is resumed as after a kill."""


def serve(
    *,
    data_dir: Path,
    demo: Demo,
    config: RunConfig,
    explicit: bool,
    encoder_weights: Path | None,
    listening: Listening,
    run: str | None,
    new_run: bool,
    again: Again,
    compare: bool = False,
) -> None:
    """Serves one run until the process is told to end (Ctrl-C or SIGTERM).

    Prints ``researcher: URL`` and ``annotator: URL`` once both can be opened.

    Args:
        data_dir: Everything is kept there.
        demo: What is to be learned.
        config: Settings of a new run.
        explicit: Whether a run that is resumed must have these settings, too.
        encoder_weights: Weights of the encoder, if not its own.
        listening: Where people reach the page; its certificate and its port can be used.
        run: Name of the run to go on with or to make; None: the newest of this demo.
        new_run: Start over even if there is a run of this demo.
        again: How many clips are asked again.
        compare: Whether annotators are asked pairs, too.

    Raises:
        UserError: If the data directory cannot be used.
    """
    sys.setswitchinterval(_SWITCH_SECONDS)
    limit_logs()
    registry.use(data_dir)
    store = Store(data_dir)
    renderer = DrawingProcess()
    secret = read_secret(data_dir)
    wanted = config if explicit else None
    found = None if new_run else find_run(store, data_dir, demo, name=run, wanted=wanted)
    if found is not None:
        run, config = found
    else:
        make_encoder(config.encoder, encoder_weights)  # before anything is written
        run = add_run(store, data_dir, demo, config, name=run)
    study = Study(store, data_dir, renderer, encoder_weights=encoder_weights, device=config.device)
    study.serve(run, demo, config)
    page = Page(study.trainer, again=again, study=study, compare=compare)
    study.served = page.serve
    front = Front(page, listening)
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    try:
        url = front.start()
        write_address(data_dir, url)
        study.trainer.start()
        for role in ("researcher", "annotator"):
            rater = store.accounts.ensure(role, role)
            print(f"{role}: {issue_link(store, secret, rater, url)}", flush=True)
        ended.wait()
        end_within(_END_SECONDS)
    finally:
        front.close()
        page.close()
        study.close()
        renderer.close()
        store.close()
