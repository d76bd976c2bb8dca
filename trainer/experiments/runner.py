"""Experiments over seeds, which can be interrupted at any time and resumed: a finished run is a file.

A study is a list of jobs, each a kind of experiment with settings and a seed. What has been run before
(by whichever study, under whichever label) is read from its file; the rest is run, each job in a process
of its own, one per core. A job should keep to one core (``rollouts.threads = 1`` in its settings).
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import IO, Any

from onedemo.core.cpu import cores
from onedemo.core.files import hold
from onedemo.errors import UserError


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of experiment."""

    function: str
    """"module:function", ``run(settings: dict, seed: int, scratch: Path) -> dict``: what was measured, its
    curves included, as JSON knows it. It is imported by the process that runs it. If it takes a ``cache``,
    it gets a directory that all jobs of a directory of results share: what is the same for all of them,
    such as a demo's features, is worked out once."""
    version: int = 1
    """To be raised when the same settings and seed would give another result (learning, physics,
    evaluation), and only then: results of older versions count as not run."""


KINDS = {
    "method": Kind("onedemo.experiments.jobs.method:run"),
    "transfer": Kind("onedemo.experiments.jobs.transfer:run"),
    "person": Kind("onedemo.experiments.jobs.person:run"),
    "predictor": Kind("onedemo.experiments.jobs.predictor_trial:run", version=2),
    "handcoded": Kind("onedemo.experiments.jobs.controls:handcoded"),
    "preferences": Kind("onedemo.experiments.jobs.controls:preferences"),
    "pose": Kind("onedemo.experiments.jobs.pose:run"),
    "truth": Kind("onedemo.experiments.jobs.controls:truth"),
}
"""By name; a new kind is one line here. "module:function" itself can stand for a kind, too.

Not raised on 2026-11-29, though the paper's method scores another state since, ``predicted_similarity``
is a mean over demo steps, and features differ in the seventh digit: the reported runs are marked as of
before in docs/results.md, and the next change of learning raises all."""

_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
_PAUSE_S = 0.1
_STOP_S = 5.0
"""A process that has not ended so long after its lifeline is killed."""
_REASON_LINES = 6
_HASH = 10
"""Hexadecimal digits of a job's hash in the name of its file."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """One run of one experiment.

    Raises:
        ValueError: If the kind is unknown, or the settings are not what JSON knows.
    """

    kind: str
    """One of ``KINDS``, or "module:function"."""
    label: str
    """What reports call it; the same run may have another label in another table."""
    settings: Mapping[str, Any]
    """Everything that the result depends on, but the seed. May be nested."""
    seed: int

    def __post_init__(self) -> None:
        if self.kind not in KINDS and ":" not in self.kind:
            raise ValueError(f"unknown kind of job {self.kind!r}; there are: {', '.join(KINDS)}")
        try:
            _ = self.key
        except (TypeError, ValueError) as error:
            raise ValueError(f"settings of job {self.label!r}: {error}") from None

    @property
    def description(self) -> dict[str, Any]:
        """What a result belongs to: a result of another description is not this job's."""
        return {
            "kind": self.kind,
            "method_version": kind_of(self).version,
            "settings": self.settings,
            "seed": self.seed,
        }

    @cached_property
    def key(self) -> str:
        """SHA-256 of the description; the label is no part of it."""
        text = json.dumps(self.description, sort_keys=True, separators=(",", ":"), allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()

    def __str__(self) -> str:
        return f"{self.label}, seed {self.seed}"


def kind_of(job: Job) -> Kind:
    """What is registered for the kind of a job."""
    return KINDS.get(job.kind) or Kind(job.kind)


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome:
    """What has become of a job."""

    job: Job
    kept: Mapping[str, Any] | None = None
    """Its file: ``result``, ``wall_s``, ``version``, ``machine`` and so on; None if there is no result."""
    reason: str = ""
    """Why there is no result: "not run", or the last lines of what the job said."""
    failed: bool = False

    @property
    def result(self) -> Mapping[str, Any] | None:
        """What the job's function returned; None if there is no result."""
        return self.kept["result"] if self.kept is not None else None

    @property
    def state(self) -> str:
        """One line: "done", "not run" or "failed: ..."."""
        if self.kept is not None:
            return "done"
        return f"failed: {self.reason.splitlines()[-1]}" if self.failed else self.reason


def by_label(outcomes: Sequence[Outcome]) -> dict[str, list[Outcome]]:
    """Outcomes of all seeds under each label, in order, those without a result included."""
    groups: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        groups.setdefault(outcome.job.label, []).append(outcome)
    return groups


def peek(jobs: Sequence[Job], results: Path) -> list[Outcome]:
    """What there is now, without running anything.

    Args:
        jobs: Of a study.
        results: Where finished runs are kept.

    Returns:
        One outcome for each job, in order; "not run" where there is no result.

    Raises:
        UserError: If a file cannot be read as a result.
    """
    return [
        Outcome(job=job, kept=kept, reason="" if kept is not None else "not run")
        for job in jobs
        for kept in [_find(job, results)]
    ]


def run_jobs(
    jobs: Sequence[Job],
    results: Path,
    *,
    workers: int | None = None,
    tell: Callable[[str], None] = lambda _: None,
) -> list[Outcome]:
    """Runs what is missing; a job that fails is told and not kept, and the others go on.

    Another study may work on the same directory: a job that it has in hand is waited for. The processes
    end when this function or this process does, however that is.

    Args:
        jobs: Of a study, most wanted first.
        results: Where finished runs are kept.
        workers: Jobs side by side; one per core if None.
        tell: Is told how far it is.

    Returns:
        One outcome for each job, in order.

    Raises:
        UserError: If a file cannot be read as a result.
    """
    done = {outcome.job.key: outcome for outcome in peek(jobs, results) if outcome.kept is not None}
    waiting: dict[str, Job] = {}
    for job in jobs:
        if job.key not in done:
            waiting.setdefault(job.key, job)
    total = len(waiting)
    if done:
        tell(f"{len(done)} finished before, {total} to run")
    running: dict[str, _Child] = {}
    try:
        while waiting or running:
            for key, job in list(waiting.items()):
                if len(running) >= (workers or cores()):
                    break
                started = _start(job, results)
                if started is None:  # another study has it in hand
                    continue
                del waiting[key]
                if isinstance(started, Outcome):  # ... and had finished it
                    done[key] = started
                else:
                    running[key] = started
                    tell(f"{job}: started")
            for key, child in list(running.items()):
                if child.process.poll() is not None:
                    done[key] = outcome = child.finish(results)
                    del running[key]
                    left = len(waiting) + len(running)
                    what = outcome.reason if outcome.failed else f"done in {child.seconds:.0f} s"
                    tell(f"{child.job}: {what} ({total - left} of {total})")
            if waiting or running:
                time.sleep(_PAUSE_S)
    finally:
        for child in running.values():
            child.process.stdin.close()  # all at once, then one after the other
        for child in running.values():
            child.stop()
    return [replace(done[job.key], job=job) for job in jobs]


def _find(job: Job, results: Path) -> dict[str, Any] | None:
    wanted = json.loads(json.dumps(job.description))
    for file in sorted(_directory(job, results).glob(f"*-{job.key[:_HASH]}.json")):
        try:
            kept = json.loads(file.read_bytes())
            _ = kept["result"]
        except (ValueError, TypeError, KeyError):
            raise UserError(f"{file} is not the result of a run; remove it, and it is run again") from None
        if wanted.items() <= kept.items():
            return kept
    return None


def _directory(job: Job, results: Path) -> Path:
    return results / _file_name(job.kind)


def _file_name(text: str) -> str:
    return re.sub(r"[^\w.+=-]+", "_", text)


class _Child:
    """A job that is being run, the lock that says so, and what it says."""

    def __init__(self, job: Job, process: Any, log: IO[bytes], lock_file: Path, held: ExitStack) -> None:
        self.job, self.process = job, process
        self._log, self._lock_file, self._held = log, lock_file, held
        self._began = time.monotonic()
        self.seconds = 0.0

    def finish(self, results: Path) -> Outcome:
        """After its end."""
        self.seconds = time.monotonic() - self._began
        self.process.stdin.close()
        code = self.process.returncode
        kept = _find(self.job, results) if code == 0 else None
        if kept is not None:
            self._lock_file.unlink(missing_ok=True)  # whoever opened it before looks for the result next
        reason = "" if kept is not None else f"{self._last_words()}\n{_ending(code)}".strip()
        self._held.close()
        return Outcome(job=self.job, kept=kept, reason=reason, failed=kept is None)

    def stop(self) -> None:
        """Ends it; its lifeline is closed already."""
        try:
            self.process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            with suppress(ProcessLookupError):
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
        self._held.close()

    def _last_words(self) -> str:
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").splitlines()
        return "\n".join([line for line in lines if line.strip()][-_REASON_LINES:])


def _ending(code: int) -> str:
    if code >= 0:
        return "" if code == 1 else f"the process ended with code {code} and no result"
    hint = ", perhaps for want of memory" if -code == signal.SIGKILL else ""
    return f"the process was ended by {signal.Signals(-code).name}{hint}"


def _start(job: Job, results: Path) -> _Child | Outcome | None:
    """Starts a job; its outcome if it has finished by now, None if another study has it in hand."""
    lock_file = _directory(job, results) / f".{job.key[:_HASH]}.lock"
    with ExitStack() as stack:
        try:
            stack.enter_context(hold(lock_file))
        except UserError:
            return None
        kept = _find(job, results)
        if kept is not None:
            lock_file.unlink(missing_ok=True)
            return Outcome(job=job, kept=kept)
        log = stack.enter_context(tempfile.TemporaryFile())
        file = _directory(job, results) / f"{_file_name(job.label)}-s{job.seed}-{job.key[:_HASH]}.json"
        request = {
            "file": str(file.absolute()),
            "function": kind_of(job).function,
            "cache": str((results / "cache").absolute()),
            "label": job.label,
            **job.description,
        }
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "onedemo.experiments.worker", json.dumps(request)],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            # It finds what this process finds, a program started from a source tree included.
            env=os.environ
            | _ONE_THREAD
            | {"PYTHONPATH": os.pathsep.join(p or os.getcwd() for p in sys.path)},
            start_new_session=True,
        )
        return _Child(job, process, log, lock_file, stack.pop_all())
