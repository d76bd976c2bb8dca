"""Starting a run from the predictor of another: what it knows of another move is fine-tuned to this one.

The run keeps a copy, ``start.pt`` in its directory, so that it goes on the same whatever becomes of the
other run.
"""

from __future__ import annotations

from pathlib import Path

from onedemo.core.files import archive_fault, write_atomic
from onedemo.errors import UserError
from onedemo.storage.run_directory import RunDirectory
from onedemo.storage.store import Store


def newest_snapshot(store: Store, data_dir: Path, run: str) -> Path:
    """The file of a run's newest predictor.

    Args:
        store: Where runs are recorded.
        data_dir: Holds ``runs/<run>/snapshots``.
        run: Its name.

    Raises:
        UserError: If there is no such run, or it has no predictor.
    """
    runs = [entry["id"] for entry in store.runs.all()]
    if run not in runs:
        raise UserError(f"no run {run!r} to start from; there are: {', '.join(runs) or 'none'}")
    rows = store.runs.snapshots(run)
    if not rows:
        raise UserError(f"run {run!r} has no similarity predictor yet: nothing was rated in it")
    for row in reversed(rows):
        file = RunDirectory(data_dir, run).snapshot(row["number"])
        if file.exists() and not archive_fault(file.read_bytes()):
            return file
    raise UserError(f"run {run!r} has no similarity predictor left: its files are missing or damaged")


def keep_start(files: RunDirectory, given: Path | None, *, begun: bool) -> Path | None:
    """Copies what a run starts from into its directory.

    Args:
        files: Of the run.
        given: A snapshot's file, or None: what was kept before.
        begun: Whether the run has a predictor of its own already.

    Returns:
        The copy; None if the run starts from nothing.

    Raises:
        UserError: If the file cannot be read, or the run began with another start or without one.
    """
    kept = files.start
    if given is None:
        return kept if kept.exists() else None
    try:
        start = given.read_bytes()
    except OSError as error:
        raise UserError(f"cannot read the predictor to start from: {error}") from None
    if kept.exists():
        if kept.read_bytes() != start:
            raise UserError(
                f"run {files.run!r} started from another predictor ({kept}); name none to go on with it"
            )
    elif begun:
        raise UserError(f"run {files.run!r} has begun without a predictor to start from")
    else:
        write_atomic(kept, start)
    return kept
