"""The runs of one data directory, one of which is served: opened, made, stopped for another."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from onedemo.config import METHODS, RunConfig, load_config, settings_for_another
from onedemo.core.directories import Workshop, sync_directory
from onedemo.core.files import hold
from onedemo.core.log_limit import LogLimit
from onedemo.core.names import check_description
from onedemo.demos.library import find_demo, list_demos
from onedemo.errors import UserError
from onedemo.render.render_thread import Drawing
from onedemo.reward.model import Snapshot, check_start
from onedemo.reward.warm_start import newest_snapshot
from onedemo.storage.run_directory import RunDirectory
from onedemo.storage.store import Store
from onedemo.training.runs import add_run, find_run
from onedemo.training.thread import Trainer
from onedemo.training.training_run import TrainingRun
from onedemo.types import Demo
from onedemo.vision.encoders import make_encoder

OFFERED = (
    "env", "ratings.pretrain", "ratings.online", "rollouts.total_steps", "ratings.clip_seconds",
    "ratings.choice",
)  # fmt: skip
"""Settings that a new run may be given in the browser, besides method and seed. The others are as in the
run at hand."""


class Study:
    """What a researcher may do with runs. Safe to use from many threads; one change at a time.

    Args:
        store: Of the data directory.
        data_dir: Everything is kept there.
        renderer: Draws clips; shared by all runs, not closed here.
        encoder_weights: Weights of the encoder, if not its own.
        device: Where predictor and policy compute.
        served: Called with the trainer whenever another run is served.
    """

    trainer: Trainer
    """Of the run that is served."""

    def __init__(
        self, store: Store, data_dir: Path, renderer: Drawing, *, encoder_weights: Path | None = None,
        device: str = "cpu", served: Callable[[Trainer], None] = lambda _: None,
    ) -> None:  # fmt: skip
        self._store, self._data_dir, self._renderer = store, data_dir, renderer
        self._encoder_weights, self._device = encoder_weights, device
        self.served = served
        self._release: Callable[[], None] = lambda: None  # the run that is served
        self._change = threading.Lock()

    def serve(self, run: str, demo: Demo, config: RunConfig, *, start: Path | None = None) -> None:
        """Serves a run that is recorded, from now on; the thread that trains it has to be started.

        Args:
            run: Its name.
            demo: What is to be learned.
            config: Its settings.
            start: Snapshot of another run that its predictor starts from.

        Raises:
            UserError: If another process works on it, or its encoder cannot be had.
        """
        encoder = make_encoder(config.encoder, self._encoder_weights)
        files = RunDirectory(self._data_dir, run)
        with ExitStack() as held:
            held.enter_context(hold(files.lock))
            held.enter_context(_log_to(files.log))
            training = TrainingRun(
                store=self._store, data_dir=self._data_dir, run=run, demo=demo,
                config=replace(config, device=self._device), encoder=encoder, renderer=self._renderer,
                start=start,
            )  # fmt: skip
            self.trainer = Trainer(training, held.pop_all())
        before, self._release = self._release, self.trainer.release
        before()
        self.served(self.trainer)

    def open(self, run: str) -> None:
        """Stops the run at hand after its iteration, and goes on with another.

        Raises:
            UserError: If there is no such run, or it cannot be resumed; then all stays as it is.
        """
        with self._change:
            if run == self.trainer.run:
                raise UserError(f"run {run!r} is being served already")
            entry = self._known(run)
            place, sha256 = self._data_dir / "demos", entry["demo_sha256"]
            # Of the same pictures, whatever its name is by now.
            same = next((demo for demo in list_demos(place) if demo.sha256 == sha256), None)
            demo = same or find_demo(entry["demo"], place)
            found = find_run(self._store, self._data_dir, demo, name=run, wanted=None)
            assert found is not None
            self._switch(run, demo, found[1])

    def create(
        self, *, demo: str, method: str, seed: int, name: str | None = None,
        predictor_from: str | None = None, settings: Mapping[str, Any] | None = None,
    ) -> str:  # fmt: skip
        """Makes a run and serves it; returns its name.

        Where nothing else is said it has the settings of the run at hand, as far as its method is the same.

        Args:
            demo: What is to be learned.
            method: "onedemo" or "paper".
            seed: Of everything random.
            name: What to call it; None: the demo's name and a number.
            predictor_from: Run from whose predictor it starts.
            settings: Those of ``OFFERED`` that were chosen, by key.

        Raises:
            UserError: If something of it cannot be; then all stays as it is.
        """
        with self._change:
            if method not in METHODS:
                raise UserError(f"there is no method {method!r}; choose from: {', '.join(METHODS)}")
            kept = settings_for_another(self.trainer.config, method)
            chosen = {key: value for key, value in (settings or {}).items() if key in OFFERED}
            found = find_demo(demo, self._data_dir / "demos")
            robot = {"env": found.robot or self.trainer.config.env}
            config = load_config(None, kept | robot | chosen | {"seed": seed, "device": self._device})
            start = None
            if predictor_from is not None:
                start = newest_snapshot(self._store, self._data_dir, predictor_from)
                check_start(Snapshot.load(start), config.predictor)
            run = add_run(self._store, self._data_dir, found, config, name=name)
            self._switch(run, found, config, start=start)
            return run

    def describe(self, run: str, *, title: str, note: str) -> None:
        """Notes what people call a run and say of it; its name stays.

        Raises:
            UserError: If there is no such run, or that cannot be shown.
        """
        self._known(run)
        check_description(title, note)
        self._store.runs.describe(run, title=title, note=note)

    def delete(self, run: str) -> None:
        """Deletes a run with its ratings and files: there is no way back but a backup.

        Raises:
            UserError: If there is no such run, or somebody works on it, here or in another process.
        """
        with self._change:
            self._known(run)
            if run == self.trainer.run:
                raise UserError(f"run {run!r} is the one being served; open another one first")
            files = RunDirectory(self._data_dir, run)
            with ExitStack() as held:
                try:
                    held.enter_context(hold(files.lock))
                except UserError:
                    raise UserError(f"another onedemo works on run {run!r}; stop that first") from None
                away = held.enter_context(Workshop(files.path.parent, ".deleted-")) / "run"
                os.replace(files.path, away)  # at once: half a run would be a damaged one
                try:
                    self._store.runs.delete(run)
                except BaseException:
                    os.replace(away, files.path)
                    raise
                sync_directory(files.path.parent)

    def _known(self, run: str) -> dict[str, Any]:
        """A run's record, as ``Runs.all``; UserError if there is none."""
        known = {entry["id"]: entry for entry in self._store.runs.all()}
        if run not in known:
            raise UserError(f"no run {run!r}; there are: {', '.join(known)}")
        return known[run]

    def close(self) -> None:
        """Stops the run at hand."""
        self.trainer.stop()
        self._release()

    def _switch(self, run: str, demo: Demo, config: RunConfig, *, start: Path | None = None) -> None:
        worked = self.trainer.retire()
        try:
            self.serve(run, demo, config, start=start)
        except BaseException:
            self.trainer.readmit(start=worked)
            raise
        self.trainer.start()


@contextmanager
def _log_to(file: Path) -> Iterator[None]:
    """Writes the log into a file for as long as the block lasts."""
    file.touch(mode=0o600)
    handler = logging.FileHandler(file)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    handler.addFilter(LogLimit())
    logger = logging.getLogger("onedemo")
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        handler.close()
