"""The trainer thread: pretrain, then refit, optimise and cut new clips, for as long as it is told.

The way of one rating: it is in the database -> before the next iteration this thread sees a new event
-> refit -> snapshot N on disk and in the database -> N scores the whole iteration -> TRPO step ->
checkpoint -> new clips are cut from the newest rollouts. If anything fails, the error is in ``status``,
clips of the last rollouts go on being cut, so that rating goes on, and after a while it is tried again.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch

from onedemo.config import RunConfig
from onedemo.core.cpu import give_way
from onedemo.core.files import read_whole
from onedemo.demos.library import read_frames
from onedemo.errors import in_words
from onedemo.render.renderer import RenderThread
from onedemo.reward.dataset import TrainingSet
from onedemo.reward.model import Snapshot
from onedemo.reward.warm_start import keep_start
from onedemo.rl.policy import PolicySnapshot
from onedemo.rl.rollouts import Acting, EpisodeRules, Transitions
from onedemo.sim import vector_env
from onedemo.sim.task_rewards import TASK_REWARDS
from onedemo.storage.run_directory import RunDirectory
from onedemo.storage.store import Store
from onedemo.training import best_rollouts
from onedemo.training.checkpoint import load_checkpoint, save_checkpoint
from onedemo.training.clip_worker import ClipMaker
from onedemo.training.comparison_queue import Pairing
from onedemo.training.learner import Learner
from onedemo.training.rating_queue import Asking, Simulated
from onedemo.types import Demo, Rollouts, Status
from onedemo.vision.encoders import Encoder, demo_features
from onedemo.vision.pose_estimator import Track
from onedemo.vision.pose_estimator import learn as learn_appearance

log = logging.getLogger("onedemo")

_TICK_S = 0.2
"""How often the thread looks for ratings while it has nothing to compute."""
_PRETRAIN_REFIT = 10
"""New ratings between two refits while the policy is not trained yet."""


_REST_S = (5.0, 300.0)
"""Before the first try after a failure, and at most: each rest is twice as long as the one before."""


class _Stopped(Exception):
    """The thread was told to end before it could begin."""


class Trainer:
    """One run: its thread, its files, its place in the database.

    Args:
        store: Shared with the page.
        data_dir: ``runs/<run>/`` and the feature cache are in it.
        run: Name of the run, recorded in the store already.
        demo: What is to be learned.
        config: The run's settings.
        encoder: Looks at the demo's frames, once.
        renderer: Draws clips for people; None if nobody looks.
        simulated: Answers in place of people; None for people.
        cache_dir: Holds what is known of demos and robots for any run; the data directory if None.
        watch: Called in the trainer's thread after each iteration.
        start: Snapshot of another run that this one's predictor starts from; a copy is kept, so a run
            that goes on needs none.
    """

    def __init__(
        self,
        *,
        store: Store,
        data_dir: Path,
        run: str,
        demo: Demo,
        config: RunConfig,
        encoder: Encoder,
        renderer: RenderThread | None = None,
        simulated: Simulated | None = None,
        cache_dir: Path | None = None,
        watch: Callable[[Learner, Snapshot], None] | None = None,
        start: Path | None = None,
    ) -> None:
        self.store, self.run, self.demo, self.config = store, run, demo, config
        self.data_dir = data_dir
        self.cache_dir = cache_dir or data_dir
        self._watch, self._start = watch, start
        self.files = RunDirectory(data_dir, run)
        self.directory = self.files.path
        self._encoder, self._renderer, self._simulated = encoder, renderer, simulated
        self._learner: Learner | None = None
        self._snapshot: Snapshot | None = None
        self._fitted_event = 0
        self._pairing: Pairing | None = None
        self._gallery = None
        if renderer is not None:
            self._gallery = best_rollouts.Gallery(self.files.rollouts, demo, self.dt, renderer)
        self._asking = Asking(store, run, config, simulated)
        self._training_set = TrainingSet(store, run, self.dt)
        self._pool: Rollouts | None = None
        self._policy: PolicySnapshot | None = None
        self._stop, self._pause = threading.Event(), threading.Event()
        self._retry = threading.Event()
        self._rest_s = _REST_S[0]
        self._retired = False
        self._control = threading.Lock()
        self._thread: threading.Thread | None = None
        self._work_began = self._work_s = 0.0
        self._status = Status(
            phase="starting",
            message="Looking at the video for the first time.",
            method=config.method,
            total_steps=config.rollouts.total_steps,
            pretrain_ratings=config.ratings.pretrain,
            target_ratings=self._asking.target,
        )
        self._held_back = self._status

    # What other threads may call

    def start(self) -> None:
        """Starts the thread; a run that was stopped goes on from its checkpoint."""
        self._stop.clear()
        self._retired = False
        if self._status.phase == "stopped":
            self._tell("starting", "The run goes on from its last checkpoint.")
        self._thread = threading.Thread(target=self._run_thread, name="trainer", daemon=True)
        self._thread.start()

    def pause(self) -> None:
        """Ends optimisation after the iteration in hand; rating goes on."""
        self._pause.set()

    def resume(self) -> None:
        """Goes on after ``pause`` or ``stop``, and tries again after a failure."""
        with self._control:  # two pages may press at once
            if self._retired:
                return
            self._pause.clear()
            self._retry.set()
            if self._stop.is_set() and self._thread is not None:
                self._thread.join()
                self.start()

    def retire(self) -> None:
        """Stops for good: ``resume`` does nothing from now on, until ``start``."""
        self._retired = True
        self.stop()

    def stop(self, timeout_s: float = 60.0) -> None:
        """Ends the run's thread after the iteration in hand; the checkpoint stays."""
        self._stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout_s)

    def status(self) -> Status:
        """What the thread is doing, as of now."""
        next_clips = None
        if self._status.phase in ("pretrain", "online") and self._work_s:
            gone = time.monotonic() - self._work_began
            next_clips = max(1.0, self._work_s - gone)
        clips = self._asking.clips
        error = self._status.error or (clips.error if clips is not None else "")
        return replace(self._status, ratings=self._asking.given(), next_clips_s=next_clips, error=error)

    @property
    def dt(self) -> float:
        """Seconds of a control step."""
        return vector_env.spec(self.config.env).dt

    def clip_file(self, clip_id: int) -> Path:
        """The picture of a clip, all its frames; it is there once the clip is "ready"."""
        return self.files.clip(clip_id)

    def want_pairs(self) -> None:
        """Somebody would compare pairs: some are made while this is said every few seconds."""
        if self._pairing is not None:
            self._pairing.want()

    def pair_file(self, pair_id: int) -> Path:
        """The picture of a pair; it is there once the pair is "ready"."""
        return self.files.pair(pair_id)

    def rollout_file(self, iteration: int, suffix: str) -> Path:
        """The best rollout of an iteration, as ``Gallery.file``.

        Raises:
            FileNotFoundError: If none was kept.
        """
        if self._gallery is None:
            raise FileNotFoundError(f"nothing of iteration {iteration} was kept")
        return self._gallery.file(iteration, suffix)

    def acting(self) -> Acting | None:
        """The newest policy beside the demo as the newest snapshot moves it; None until there is a policy.

        Any thread may ask. What it gets is its own and does not change: ask again for each episode.
        """
        learner, policy, snapshot = self._learner, self._policy, self._snapshot
        if learner is None or policy is None:
            return None
        rules = learner.rules(1, snapshot) if snapshot is not None else EpisodeRules()
        return Acting(policy=policy, rules=rules)

    # The thread

    def _run_thread(self) -> None:
        give_way()  # people at the page come first
        self.work()

    def work(self) -> None:
        """Runs until done or stopped; a failure is shown in ``status`` and tried again."""
        while not self._stop.is_set():
            try:
                self._work()
                return
            except _Stopped:
                self._tell_stopped()
            except Exception as error:
                if self._simulated is not None:
                    raise
                log.exception("run %s: the trainer failed", self.run)
                self._rest_after(error)

    def final_policy(self) -> tuple[Learner, Snapshot | None]:
        """What was learned, for evaluation once the thread has ended."""
        assert self._learner is not None, "the trainer has not run"
        return self._learner, self._snapshot

    def _work(self) -> None:
        learner = self._prepare()
        limit = self.config.rollouts.total_steps
        while not self._stop.is_set():
            self._ask(learner)
            if learner.env_steps >= limit:
                self._tell("done", "The robot has practised as long as it was told to.")
                if self._simulated is not None:
                    return
                self._stop.wait(_TICK_S)
            elif self._pause.is_set():
                self._tell("paused", "Practice is paused. Ratings still count.")
                self._stop.wait(_TICK_S)
            elif learner.iteration == 0 and self._asking.given() < self.config.ratings.pretrain:
                self._tell(
                    "pretrain",
                    "So far the robot moves at random. It practises once it has learned from "
                    f"{self.config.ratings.pretrain} ratings.",
                )
                self._work_began = time.monotonic()
                if self._refit(learner, at_least=_PRETRAIN_REFIT if self._simulated is None else 1):
                    self._work_s = time.monotonic() - self._work_began
                self._stop.wait(_TICK_S)
            else:
                self._iterate(learner)
            self._went_well()
        self._tell_stopped()

    def _prepare(self) -> Learner:
        # The networks that learn are too small to be split: threads would wait for each other more than
        # they compute, the longer the busier the machine. Their first weights depend on the number, too.
        torch.set_num_threads(1)
        begun = bool(self.store.runs.snapshots(self.run))
        start = keep_start(self.files, self._start, begun=begun)
        first = Snapshot.load(start, self.config.device) if start is not None else None
        learner = Learner(self.config, self.demo.frames, self.demo.fps, first)
        if not self._load_checkpoint(learner):
            self._pool = learner.random_rollouts()
        self._learner = learner
        self._load_snapshot()
        if self._renderer is not None:
            frames = read_frames(self.demo)
            self._asking.clips = ClipMaker(
                self.store, file=self.clip_file, frames=frames, frames_of=learner.frames_of,
                renderer=self._renderer,
            )  # fmt: skip
            self._pairing = Pairing(
                self.store, self.run, self.files.pair, frames, self._renderer, self.config.seed
            )
            self._asking.clips.recover(self.run)
        with ThreadPoolExecutor(1, "look") as beside:
            looking = beside.submit(self._look)
            while not looking.done():
                if self._simulated is None:
                    self._ask(learner)  # people rate meanwhile
                wait([looking], _TICK_S)
        torch.set_num_threads(1)
        learner.look_at(*looking.result())
        self._policy = learner.policy()
        return learner

    def _ask(self, learner: Learner) -> None:
        self._asking.fill(learner, self._pool, self._snapshot)
        if self._pairing is not None:
            self._pairing.fill(learner, self._pool)

    def _look(self) -> tuple[np.ndarray, Track | None]:
        """Looks at the demo, and at the robot if asked for: a minute or more the first time.

        Returns:
            Features of the demo's frames, (F, D), and what they show of the robot, if that can be told.
        """
        torch.set_num_threads(self.config.rollouts.threads)
        features = demo_features(self.demo, self._encoder, self.cache_dir / "demos")
        if not self.config.predictor.appearance:
            return features, None
        self._tell("starting", "Looking at pictures of the robot: about a minute, the first time only.")
        look = learn_appearance(self.config.env, self._encoder, self.cache_dir / "robots", self._check)
        return features, look.track(features, self.demo.fps) if look.knows(features) else None

    def _check(self) -> None:
        if self._stop.is_set():
            raise _Stopped

    def _iterate(self, learner: Learner) -> None:
        began = self._work_began = time.monotonic()
        self._refit(learner, at_least=1)
        snapshot = self._snapshot
        assert snapshot is not None, "the policy is trained on a snapshot"
        self._tell("online", "The robot is practising with what it learned from your ratings.")
        before = learner.env_steps
        rollouts, stats = learner.iterate(snapshot)
        stats |= self._true_reward(rollouts)
        if self._gallery is not None:
            stats |= self._gallery.note(
                learner.iteration, snapshot, rollouts, learner.frames_of, learner.demo_steps
            )
        self._work_s = time.monotonic() - began
        stats["steps_per_s"] = (learner.env_steps - before) / self._work_s
        self._pool, self._policy = rollouts, learner.policy()
        row = {"snapshot": snapshot.number, "env_steps": learner.env_steps, "stats": stats}
        left = self._asking.given() < self._asking.target
        save_checkpoint(self.files.checkpoint, learner.state_dict(), row, rollouts if left else None)
        self.store.runs.add_iteration(self.run, learner.iteration, **row)
        self._asking.withdraw_stale(learner.iteration)
        if self._watch is not None:
            self._watch(learner, snapshot)
        self._tell("online", "The robot is practising with what it learned from your ratings.", stats)

    def _refit(self, learner: Learner, at_least: int) -> bool:
        """Publishes a new snapshot if there are ``at_least`` so many new events; whether it did."""
        event = self.store.ratings.last_event()
        if event == self._fitted_event or event - self._fitted_event < at_least:
            return False
        ratings = self._training_set.at(event)
        if not ratings:
            return False
        number = (self._snapshot.number if self._snapshot else 0) + 1
        snapshot, stats = learner.fit(ratings, number)
        snapshot.save(self.files.snapshot(number))
        self.store.runs.add_snapshot(
            self.run, number, last_event=event, ratings=len(ratings), stats=asdict(stats)
        )
        self._snapshot, self._fitted_event = snapshot, event
        self._asking.predict_waiting(learner, snapshot)
        return True

    def _true_reward(self, rollouts: Transitions) -> dict[str, float]:
        """The hand-coded reward where the demo's task has one: shown, never learned from."""
        if self.demo.task not in TASK_REWARDS:
            return {}
        reward = TASK_REWARDS[self.demo.task](
            rollouts.next_obs, rollouts.actions, rollouts.qpos, rollouts.next_qpos, rollouts.next_qvel
        )
        assert self._learner is not None
        return {"true_reward": float(reward.mean() * self._learner.demo_steps)}

    def _rest_after(self, error: Exception) -> None:
        """Shows a failure and keeps cutting clips, until it is time or somebody says to try again."""
        self._tell(
            "failed",
            "The robot has stopped practising, and soon tries again. Your ratings are kept, and still count.",
        )
        self._status = replace(self._status, error=in_words(error))
        until, self._rest_s = time.monotonic() + self._rest_s, min(2 * self._rest_s, _REST_S[1])
        self._retry.clear()
        while not (self._stop.is_set() or self._retry.wait(_TICK_S) or time.monotonic() > until):
            try:
                if self._learner is not None:
                    self._ask(self._learner)
            except Exception:
                log.debug("run %s: still failing", self.run, exc_info=True)

    def _went_well(self) -> None:
        self._rest_s = _REST_S[0]
        if self._status.error:
            self._status = replace(self._held_back, error="")

    def _tell_stopped(self) -> None:
        self._tell("stopped", "The run is stopped. It can be started again where it was.")

    def _tell(self, phase: str, message: str, stats: dict | None = None) -> None:
        learner = self._learner
        told = replace(
            self._status,
            phase=phase,
            message=message,
            iteration=learner.iteration if learner else 0,
            env_steps=learner.env_steps if learner else 0,
            snapshot=self._snapshot.number if self._snapshot else 0,
            steps_per_s=stats["steps_per_s"] if stats else self._status.steps_per_s,
        )
        if self._status.error and phase not in ("failed", "stopped"):
            self._held_back = told  # what failed is tried again, and has not gone well yet
        else:
            self._status = told

    # Files

    def _load_snapshot(self) -> None:
        """The newest snapshot that the database knows and the disk holds whole."""
        for row in reversed(self.store.runs.snapshots(self.run)):
            file = self.files.snapshot(row["number"])
            if read_whole(file) is not None:
                self._snapshot = Snapshot.load(file, self.config.device)
                self._fitted_event = row["last_event"]
                return

    def _load_checkpoint(self, learner: Learner) -> bool:
        saved = load_checkpoint(self.files.checkpoint)
        if saved is None:
            return False
        state, row, self._pool = saved
        learner.load_state_dict(state)
        # The process may have died between the file and the row.
        self.store.runs.add_iteration(self.run, learner.iteration, **row)
        return True
