"""The commands that look after the data: ``backup``, ``restore``, ``doctor``."""

from __future__ import annotations

from pathlib import Path

from onedemo.app.cli.data import DATA, DataDir, check_output
from onedemo.errors import UserError


def backup(file: Path, /, *, force: bool = False, data_dir: DataDir = DATA) -> None:
    """Everything in one file, also while the server runs.

    Args:
        file: The archive, such as study.zip.
        force: Replace FILE if it is there.
    """
    from onedemo.app.admin.backup import back_up

    check_output(file, data_dir)
    if file.exists() and not force:
        raise UserError(f"{file} is there already; choose another name, or replace it with --force")
    try:
        there = back_up(data_dir, file)
    except OSError as error:
        raise UserError(f"cannot write {file}: {error.strerror or error}") from None
    print(f"{file}: {there.files:,} files, {there.ratings:,} ratings, {there.bytes / 1e6:,.1f} MB")
    if there.left_out:
        names = ", ".join(there.left_out[:3]) + (", ..." if len(there.left_out) > 3 else "")
        print(f"left out, since onedemo did not write it: {len(there.left_out)} files ({names})")
    for saved in there.rescued:
        print(f"not in it: {saved}, which a server saved when its database was deleted; see `onedemo doctor`")
    print("it holds the secret behind people's links: keep it where only you can read it")


def restore(file: Path, /, *, data_dir: DataDir = DATA) -> None:
    """A backup into a new data directory.

    Args:
        file: What `onedemo backup` wrote.
    """
    from onedemo.app.admin.restore import restore

    there = restore(file, data_dir)
    print(f"{data_dir}: {there['files']:,} files, {there['ratings']:,} ratings, links as they were")


def doctor(*, full: bool = False, data_dir: DataDir = DATA) -> int:
    """What is wrong with installation and data, if anything.

    Args:
        full: Read every row of the database, too: a minute for 100,000 ratings.
    """
    from onedemo.app.admin import environment

    wrong = 0
    for fault in environment.faults():
        wrong += 1
        print(f"BAD  {'installation':16} {fault}", flush=True)
    try:
        from onedemo.app.admin.doctor import examine
    except Exception:  # by what was said above
        if not wrong:
            raise
        print("no more can be looked at before that is mended")
        return 1
    for finding in examine(data_dir, full=full):
        wrong += not finding.ok
        print(f"{'ok  ' if finding.ok else 'BAD '} {finding.what:16} {finding.said}", flush=True)
    if wrong:
        print(f"{wrong} thing{'s' if wrong > 1 else ''} to look after")
    return int(wrong > 0)
