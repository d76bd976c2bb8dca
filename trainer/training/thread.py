"""The thread that works on a run at the pace of people: started, paused, resumed, stopped, tried again.

If anything fails, the error is in ``status``, clips of the last rollouts go on being cut, so that rating
goes on, and after a while it is tried again.
"""

from __future__ import annotations

import logging
import threading
import time
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ExitStack

from onedemo.core.cpu import give_way
from onedemo.errors import in_words
from onedemo.training.training_run import TrainingRun
from onedemo.types import HALTED, Status
from onedemo.vision.pose_estimator import Track

log = logging.getLogger("onedemo")

_TICK_S = 0.2
"""How often the thread looks for ratings while it has nothing to compute."""
_PRETRAIN_REFIT = 10
"""New ratings between two refits while the policy is not trained yet."""


class _Stopped(Exception):
    """The thread was told to end before it could begin."""


class Trainer:
    """A run and its thread. Any thread may call what is public here.

    Args:
        training: What is worked on; the thread alone changes it.
        held: What nobody else may have while the run is worked on, its lock above all. It is closed by
            whoever is last: ``release``, or the thread, if it still works then.
        rest_s: Seconds before the first try after a failure, and at most: each rest is twice as long as the
            one before.
    """

    def __init__(
        self,
        training: TrainingRun,
        held: ExitStack | None = None,
        *,
        rest_s: tuple[float, float] = (5.0, 300.0),
    ) -> None:
        self._training = training
        self.store, self.run, self.demo = training.store, training.run, training.demo
        self.config, self.data_dir, self.dt = training.config, training.data_dir, training.dt
        self.robot = training.robot
        self.directory = training.files.path
        self.acting = training.acting
        self.want_pairs = training.want_pairs
        self.clip_picture, self.pair_picture = training.clip_picture, training.pair_picture
        self.rollout_picture = training.rollout_picture
        self._held = held or ExitStack()
        self._control = threading.Lock()
        self._thread: threading.Thread | None = None
        self._working = 0  # threads that have not ended: more than one after a stop that timed out
        self._released = self._retired = False
        self._stop, self._pause, self._retry = (threading.Event() for _ in range(3))
        self._first_rest_s, self._longest_rest_s = rest_s
        self._rest_s = self._first_rest_s
        self._work_began = self._work_s = 0.0
        self._work_of = ""  # the phase in which it took that long
        self._phase, self._error = "starting", ""
        self._next_phase = ""  # of a try after a failure, shown once it has gone well

    def start(self) -> None:
        """Starts the thread; a run that was stopped continues from its checkpoint."""
        with self._control:
            self._start()

    def pause(self) -> None:
        """Ends optimisation after the iteration in hand; rating goes on."""
        self._pause.set()

    def resume(self) -> None:
        """Continues after ``pause`` or ``stop``, and tries again after a failure."""
        with self._control:  # two pages may press at once
            if self._retired:
                return
            self._pause.clear()
            self._retry.set()
            if self._stop.is_set():
                self._start()

    def retire(self) -> bool:
        """Stops for good: ``resume`` does nothing from now on, until ``start`` or ``readmit``.

        Returns:
            Whether anybody worked on the run, who had not been told to stop before.
        """
        with self._control:
            self._retired = True
            worked = self._thread is not None and not self._stop.is_set()
        self.stop()
        return worked

    def readmit(self, *, start: bool) -> None:
        """Takes ``retire`` back, and starts the run again if it is to be."""
        with self._control:
            self._retired = False
            if start:
                self._start()

    def stop(self, timeout_s: float = 60.0) -> None:
        """Ends the run's thread after the iteration in hand; the checkpoint stays.

        Args:
            timeout_s: How long to wait for that; afterwards the thread may still be working.
        """
        self._stop.set()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(timeout_s)

    def release(self) -> None:
        """Lets others have the run as soon as no thread works on it any more; after ``stop``."""
        with self._control:
            self._released = True
            self._let_go()

    @property
    def track(self) -> Track | None:
        """What the demo shows of the robot, as far as is known; None if not yet, or if it shows none."""
        return self._training.track

    def status(self) -> Status:
        """What the thread is doing, as of now."""
        training, config, phase = self._training, self.config, self._phase
        next_clips = None
        if phase == self._work_of:
            next_clips = max(1.0, self._work_s - (time.monotonic() - self._work_began))
        progress, left = training.looking() if phase == "starting" else (None, None)
        message = training.preparing if phase == "starting" else ""
        clips, snapshot, lost = training.queue.clips, training.snapshot, self.store.database.fault
        if lost:
            phase = "failed"
        elif self._stop.is_set() and self._working:
            phase = "stopping"
        elif self._pause.is_set() and phase in ("starting", "pretrain", "online"):
            phase = "pausing" if phase == "online" else "paused"
        return Status(
            phase=phase,
            message=message,
            progress=progress,
            left_s=left,
            method=config.method,
            saved=not lost,
            error=lost or self._error or (clips.error if clips is not None else ""),
            iteration=training.iteration,
            env_steps=training.env_steps,
            total_steps=config.rollouts.total_steps,
            steps_per_s=training.steps_per_s,
            unstable=training.unstable,
            snapshot=snapshot.number if snapshot is not None else 0,
            ratings=training.queue.given(),
            pretrain_ratings=config.ratings.pretrain,
            target_ratings=training.queue.target,
            next_clips_s=next_clips,
        )

    # The thread

    def _start(self) -> None:
        self._retired = False
        if self._phase == "stopped":
            self._training.preparing = "The run continues from where it was."
            self._phase = "starting"
        # Each thread has an event of its own: one that has not ended yet is not told to go on.
        self._stop, before = threading.Event(), self._thread
        thread = threading.Thread(
            target=self._run_thread, args=(self._stop, before), name="trainer", daemon=True
        )
        self._working += 1
        try:
            thread.start()
        except BaseException:
            self._working -= 1
            raise
        self._thread = thread

    def _run_thread(self, stop: threading.Event, before: threading.Thread | None) -> None:
        try:
            if before is not None:
                before.join()
            give_way()  # people at the page come first
            while True:
                try:
                    self._work(stop)
                except _Stopped:
                    pass
                except Exception as error:
                    log.exception("run %s: the trainer failed", self.run)
                    self._rest_after(error, stop)
                if stop.is_set():  # not before: what a run starts from is kept even if it is stopped at once
                    break
        finally:
            with self._control:
                self._working -= 1
                if not self._working:
                    self._tell("stopped")
                self._let_go()

    def _let_go(self) -> None:
        if self._released and not self._working:
            self._held.close()

    def _work(self, stop: threading.Event) -> None:
        training = self._training
        training.open()
        self._look(stop)
        while not stop.is_set():
            training.ask()
            phase = training.phase
            if phase != "done" and self._pause.is_set():
                phase = "paused"
            self._tell(phase)
            self._work_began = time.monotonic()
            if phase == "online":
                training.iterate()
            if phase == "online" or (phase == "pretrain" and training.refit(at_least=_PRETRAIN_REFIT)):
                self._work_s, self._work_of = time.monotonic() - self._work_began, phase
            if phase != "online":
                stop.wait(_TICK_S)
            self._went_well()

    def _look(self, stop: threading.Event) -> None:
        """Looks at demo and robot, in a thread of its own, while people rate."""

        def check() -> None:
            if stop.is_set():
                raise _Stopped

        with ThreadPoolExecutor(1, "look") as beside:
            looking = beside.submit(self._training.look, check)
            while not looking.done():
                self._training.ask()
                wait([looking], _TICK_S)
        self._training.see(*looking.result())

    def _rest_after(self, error: Exception, stop: threading.Event) -> None:
        """Shows a failure and keeps cutting clips, until it is time or somebody says to try again."""
        self._error = in_words(error)
        self._tell("failed")
        until = time.monotonic() + self._rest_s
        self._rest_s = min(2 * self._rest_s, self._longest_rest_s)
        self._retry.clear()
        while not (stop.is_set() or self._retry.wait(_TICK_S) or time.monotonic() > until):
            try:
                if self._training.learner is not None:
                    self._training.ask()
            except Exception:
                log.debug("run %s: still failing", self.run, exc_info=True)

    def _went_well(self) -> None:
        self._rest_s = self._first_rest_s
        if self._error:
            self._error = ""
            self._enter(self._next_phase)

    def _tell(self, phase: str) -> None:
        if self._error and phase not in ("failed", "stopped"):
            self._next_phase = phase  # what failed is tried again, and has not gone well yet
        else:
            self._enter(phase)

    def _enter(self, phase: str) -> None:
        before, self._phase = self._phase, phase
        going = phase == "online" and self._training.iteration > 0
        if phase == before or not (going or phase in HALTED):
            return
        try:
            self._training.mark("resumed" if going else phase)
        except Exception:  # the charts lack it; the phase is what counts
            log.debug("run %s: %s could not be noted", self.run, phase, exc_info=True)
