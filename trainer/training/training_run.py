"""One training, step by step: ask for ratings, refit the reward model, improve the policy, keep it all.

The way of one rating: it is in the database -> before the next iteration a new event is seen -> refit ->
snapshot N on disk and in the database -> N scores the whole iteration -> TRPO step -> checkpoint -> new
clips are cut from the newest rollouts.

No thread and no waiting is in here: ``simulated_run.train`` calls ``step`` until the run is done,
``thread.Trainer`` works at the pace of people.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from onedemo.config import RunConfig
from onedemo.core.files import read_whole
from onedemo.demos.library import read_frames
from onedemo.render.render_thread import Drawing
from onedemo.reward.dataset import TrainingSet
from onedemo.reward.model import Snapshot
from onedemo.reward.warm_start import keep_start
from onedemo.rl.policy import PolicySnapshot
from onedemo.rl.rollouts import Acting, EpisodeRules, Transitions
from onedemo.robots.registry import robot_named
from onedemo.sim.task_rewards import TASK_REWARDS
from onedemo.storage.rating_records import RatedSegment
from onedemo.storage.run_directory import RunDirectory
from onedemo.storage.store import Store
from onedemo.training.best_rollouts import Gallery
from onedemo.training.checkpoint import load_checkpoint, save_checkpoint
from onedemo.training.clip_worker import ClipMaker
from onedemo.training.comparison_queue import ComparisonQueue
from onedemo.training.learner import Learner
from onedemo.training.pictures import PictureFiles, tidy
from onedemo.training.rating_queue import RatingQueue, Simulated
from onedemo.types import Clip, Demo, Rollouts
from onedemo.vision import silhouette
from onedemo.vision.encoders import Encoder, demo_features
from onedemo.vision.mask_file import masks_of
from onedemo.vision.pose_estimator import Track, with_ground
from onedemo.vision.silhouette import Silhouette

_TIDY_S = 10.0
"""Between two looks at what pictures can be deleted."""
_TOLD_FROM = 0.02
"""Share of the work from which on its pace tells how long the rest takes."""


class _Drawn(NamedTuple):
    """What is drawn of a run that somebody looks at."""

    pictures: PictureFiles
    clips: ClipMaker
    pairs: ComparisonQueue
    rollouts: Gallery


class TrainingRun:
    """One run: what it learns, its files, its place in the database. One thread at a time works on it.

    Other threads may read its attributes, and call ``acting``, ``want_pairs`` and what gives pictures.

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
        watch: Called after each iteration.
        start: Snapshot of another run that this one's predictor starts from; a copy is kept, so a resumed
            run needs none.
        learn_robot: Learns what the robot looks like, as ``onedemo.vision.silhouette.learn``.
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
        renderer: Drawing | None = None,
        simulated: Simulated | None = None,
        cache_dir: Path | None = None,
        watch: Callable[[Learner, Snapshot], None] | None = None,
        start: Path | None = None,
        learn_robot: Callable[..., Silhouette] = silhouette.learn,
    ) -> None:
        self.store, self.run, self.demo, self.config = store, run, demo, config
        self.data_dir = data_dir
        self.files = RunDirectory(data_dir, run)
        self.robot = robot_named(config.env)
        """What learns."""
        self.dt = self.robot.dt
        """Seconds of a control step."""
        self.queue = RatingQueue(store, run, config, simulated)
        """The clips that are put to annotators."""
        self.learner: Learner | None = None
        """None until ``open``."""
        self.snapshot: Snapshot | None = None
        """The newest; None before the first fit."""
        self.iteration = self.env_steps = 0
        """Of the last iteration that is in the database."""
        self.steps_per_s = 0.0
        """Control steps per second in the last iteration."""
        self.unstable = 0
        """Episodes that ended because the robot's physics became unstable."""
        self.preparing = "The run is being opened."
        """What comes before the first ``step``: what is done of it now, one sentence."""
        self.track: Track | None = None
        """What the demo shows of the robot, as far as is known; None before ``see``, or if it shows none."""
        self._learning: tuple[float, float] | None = None
        self._encoder, self._learn_robot = encoder, learn_robot
        self._cache_dir, self._watch, self._start = cache_dir or data_dir, watch, start
        self._drawn: _Drawn | None = None
        if renderer is not None:
            pictures = PictureFiles(renderer, demo, self.robot)
            self.queue.clips = ClipMaker(store, file=self.files.clip, pictures=pictures)
            self._drawn = _Drawn(
                pictures,
                self.queue.clips,
                ComparisonQueue(store, run, self.files.pair, pictures, config.seed),
                Gallery(self.files.rollouts, pictures),
            )
        self._tidy_at = 0.0
        self._training_set = TrainingSet(store, run)
        self._fitted_event = 0
        self._fitted_clips: set[int] = set()
        """Those that the newest snapshots were fitted on."""
        self._pool: Rollouts | None = None
        self._policy: PolicySnapshot | None = None

    # Preparing

    def prepare(self) -> None:
        """Opens the run and looks at the demo: all that comes before the first ``step``."""
        self.open()
        self.see(*self.look())

    def open(self) -> None:
        """Takes up the run where its checkpoint is, or at its beginning; from then on ``ask`` works.

        Raises:
            UserError: If the demo, the device or the predictor to start from do not fit.
        """
        # The networks that learn are too small to be split: threads would wait for each other more than
        # they compute, the longer the busier the machine. Their first weights depend on the number, too.
        torch.set_num_threads(1)
        begun = bool(self.store.runs.snapshots(self.run))
        start = keep_start(self.files, self._start, begun=begun)
        first = Snapshot.load(start, self.config.device) if start is not None else None
        learner = Learner(self.config, self.demo.frames, self.demo.fps, first)
        if not self._load_checkpoint(learner):
            self._pool = learner.random_rollouts()
        self.learner, self.iteration, self.env_steps = learner, learner.iteration, learner.env_steps
        self.unstable = int(sum(row.get("unstable", 0) for row in self.store.runs.iterations(self.run)))
        self._load_snapshot()
        if self._drawn is not None:
            self._drawn.clips.recover(self.run)

    def look(self, check: Callable[[], None] = lambda: None) -> tuple[np.ndarray, Track | None]:
        """Looks at the demo, and reads the robot's pose in it if asked for.

        That takes seconds for a robot that comes with the program, and minutes the first time for another.

        Another thread than the one that asks may do it.

        Args:
            check: Called now and then; may raise to end it.

        Returns:
            Features of the demo's frames, (F, D), and what they show of the robot, if that can be told.
        """
        torch.set_num_threads(self.config.rollouts.threads)
        self.preparing = "The demonstration video is looked at."
        features = demo_features(self.demo, self._encoder, self._cache_dir / "demos")
        if not self.config.predictor.appearance:
            return features, None
        if (track := silhouette.known_track(self.demo, self.config.env)) is not None:
            return features, track
        began = time.monotonic()

        def note(share: float = 0.0) -> None:  # never called if it was learned before
            self.preparing = "Pictures of the robot are looked at, so that its pose can be told."
            self._learning = began, share
            check()

        try:
            shapes = self._learn_robot(self.config.env, self._cache_dir / "robots", note)
        finally:
            self._learning = None
        self.preparing = "The robot is looked for in the demonstration video."
        track = shapes.track(masks_of(self.demo, shapes.reach), self.demo.fps)
        if track is None:
            return features, None
        robot = robot_named(self.config.env)
        return features, with_ground(track, read_frames(self.demo), self.demo.fps, robot)

    def looking(self) -> tuple[float | None, float | None]:
        """How much of learning what the robot looks like is done, 0 to 1, and seconds left; None: not known.

        Any thread may ask.
        """
        if (learning := self._learning) is None:
            return None, None
        began, share = learning
        spent = time.monotonic() - began
        return share, spent / share - spent if share >= _TOLD_FROM else None

    def see(self, features: np.ndarray, track: Track | None) -> None:
        """Takes in what ``look`` found; from then on ``refit`` and ``iterate`` work."""
        torch.set_num_threads(1)
        self.track = track
        self._opened.look_at(features, track)
        self._policy = self._opened.policy()

    # Working

    @property
    def phase(self) -> str:
        """What comes next: "pretrain" (ratings, before the policy is trained), "online" or "done"."""
        if self._opened.env_steps >= self.config.rollouts.total_steps:
            return "done"
        early = self._opened.iteration == 0 and self.queue.given() < self.config.ratings.pretrain
        return "pretrain" if early else "online"

    def step(self) -> str:
        """Asks, then refits or makes an iteration, whichever is due; the phase that it found.

        For simulated annotators, who answer within it: while people have yet to rate, nothing happens.
        """
        self.ask()
        phase = self.phase
        if phase == "pretrain":
            self.refit()
        elif phase == "online":
            self.iterate()
        return phase

    def ask(self) -> None:
        """Fills the queues of clips and pairs; simulated annotators answer at once."""
        self.queue.fill(self._opened, self._pool, self.snapshot)
        if self._drawn is not None:
            self._drawn.pairs.fill(self._opened, self._pool)
            if time.monotonic() > self._tidy_at:
                self._tidy_at = time.monotonic() + _TIDY_S
                most = self.config.storage.pictures_gb * 1e9
                tidy(self.store, self.files, most, self._drawn.pictures.recent())

    def refit(self, at_least: int = 1) -> bool:
        """Publishes a new snapshot if there are ``at_least`` so many new events; whether it did."""
        event = self.store.ratings.last_event()
        if event == self._fitted_event or event - self._fitted_event < at_least:
            return False
        ratings = self._training_set.at(event)
        if not ratings:
            return False
        number = (self.snapshot.number if self.snapshot else 0) + 1
        forecast = self._forecast(ratings)
        snapshot, stats = self._opened.fit(ratings, number)
        snapshot.save(self.files.snapshot(number))
        self.store.runs.add_snapshot(
            self.run, number, last_event=event, ratings=len(ratings), stats=asdict(stats) | forecast
        )
        self.snapshot, self._fitted_event = snapshot, event
        self._fitted_clips |= {rating.clip for rating in ratings}
        self.queue.predict_waiting(self._opened, snapshot)
        return True

    def iterate(self) -> None:
        """One iteration with the newest ratings, and all that is kept of it."""
        began = time.monotonic()
        self.refit()
        refitted = time.monotonic()
        learner, snapshot = self._opened, self.snapshot
        assert snapshot is not None, "the policy is trained on a snapshot"
        before = learner.env_steps
        rollouts, learned = learner.iterate(snapshot)
        stats: dict[str, Any] = {**learned, **self._true_reward(rollouts)}
        stats |= learner.diagnose(rollouts, snapshot)
        if self._drawn is not None:
            gallery = self._drawn.rollouts
            stats |= gallery.note(learner.iteration, rollouts, learner.frames_of, learner.demo_steps)
        took = time.monotonic() - began
        seconds = {"refit": refitted - began, **learner.seconds}
        stats["seconds"] = seconds | {"other": max(0.0, took - sum(seconds.values()))}
        stats["steps_per_s"] = (learner.env_steps - before) / took
        self._pool, self._policy = rollouts, learner.policy()
        row = {"snapshot": snapshot.number, "env_steps": learner.env_steps, "stats": stats}
        left = self.queue.given() < self.queue.target
        save_checkpoint(self.files.checkpoint, learner.state_dict(), row, rollouts if left else None)
        self.store.runs.add_iteration(self.run, learner.iteration, **row)
        self.queue.withdraw_stale(learner.iteration)
        self.iteration, self.env_steps = learner.iteration, learner.env_steps
        self.steps_per_s = stats["steps_per_s"]
        self.unstable += int(stats.get("unstable", 0))
        if self._watch is not None:
            self._watch(learner, snapshot)

    # What other threads may call

    def mark(self, kind: str) -> None:
        """Notes for the charts that the run was held or went on, as ``Runs.mark``."""
        self.store.runs.mark(self.run, self.iteration, kind)

    def acting(self) -> Acting | None:
        """The newest policy beside the demo as the newest snapshot moves it; None until there is a policy.

        What the caller gets is its own and does not change: ask again for each episode.
        """
        learner, policy, snapshot = self.learner, self._policy, self.snapshot
        if learner is None or policy is None:
            return None
        rules = learner.rules(1, snapshot) if snapshot is not None else EpisodeRules()
        return Acting(policy=policy, rules=rules)

    def want_pairs(self) -> None:
        """Somebody would compare pairs: some are made while this is said every few seconds."""
        if self._drawn is not None:
            self._drawn.pairs.want()

    def clip_picture(self, clip: Clip) -> Future[Path]:
        """The future of the picture of a clip of this run; drawn again if it was deleted."""
        return self._pictured.clips.picture(clip)

    def pair_picture(self, pair_id: int) -> Future[Path]:
        """The same of a pair.

        Raises:
            KeyError: If there is none.
        """
        return self._pictured.pairs.picture(pair_id)

    def rollout_picture(self, iteration: int, suffix: str) -> Future[Path]:
        """The best rollout of an iteration, as ``Gallery.picture``.

        Raises:
            FileNotFoundError: If none was kept.
        """
        return self._pictured.rollouts.picture(iteration, suffix)

    # Helpers

    @property
    def _pictured(self) -> _Drawn:
        assert self._drawn is not None, "nobody looks at this run"
        return self._drawn

    @property
    def _opened(self) -> Learner:
        assert self.learner is not None, "open() comes first"
        return self.learner

    def _forecast(self, ratings: Sequence[RatedSegment]) -> dict[str, float]:
        """How right the newest snapshot is about clips that it was not fitted on, as ``Learner.forecast``."""
        if self.snapshot is None:
            return {}
        new = [r for r in ratings if r.event > self._fitted_event and r.clip not in self._fitted_clips]
        return self._opened.forecast(self.snapshot, new)

    def _true_reward(self, rollouts: Transitions) -> dict[str, float]:
        """The hand-coded reward where the demo's task has one: shown, never used for training."""
        if self.demo.task not in TASK_REWARDS:
            return {}
        reward = TASK_REWARDS[self.demo.task](
            rollouts.next_obs, rollouts.actions, rollouts.qpos, rollouts.next_qpos, rollouts.next_qvel
        )
        return {"true_reward": float(reward.mean() * self._opened.demo_steps)}

    def _load_snapshot(self) -> None:
        """The newest snapshot that the database knows and the disk holds whole."""
        for row in reversed(self.store.runs.snapshots(self.run)):
            file = self.files.snapshot(row["number"])
            if read_whole(file) is not None:
                self.snapshot = Snapshot.load(file, self.config.device)
                self._fitted_event = row["last_event"]
                fitted = self.store.ratings.for_training(self.run, self._fitted_event)
                self._fitted_clips = {rating.clip for rating in fitted}
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
