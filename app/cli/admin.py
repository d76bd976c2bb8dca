"""The commands that look after the data: ``backup``, ``restore``, ``doctor``."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from onedemo.app.cli.data import add_data_dir, check_output
from onedemo.errors import UserError


def add_care_commands(commands: Any, command: Callable[..., argparse.ArgumentParser]) -> None:
    """Adds them to the command line. Arguments as ``onedemo.app.cli.data.add_data_commands``."""
    save = command(commands, "backup", _backup, "everything in one file, also while the server runs")
    save.add_argument("file", type=Path, metavar="FILE", help="the archive, such as study.zip")
    save.add_argument("--force", action="store_true", help="replace FILE if it is there")
    back = command(commands, "restore", _restore, "a backup into a new data directory")
    back.add_argument("file", type=Path, metavar="FILE", help="what `onedemo backup` wrote")
    look = command(commands, "doctor", _doctor, "what is wrong with installation and data, if anything")
    for parser in (save, back, look):
        add_data_dir(parser)


def _backup(arguments: argparse.Namespace) -> None:
    from onedemo.app.admin.backup import back_up

    file: Path = arguments.file
    check_output(file, arguments.data_dir)
    if file.exists() and not arguments.force:
        raise UserError(f"{file} is there already; choose another name, or replace it with --force")
    try:
        there = back_up(arguments.data_dir, file)
    except OSError as error:
        raise UserError(f"cannot write {file}: {error.strerror or error}") from None
    print(f"{file}: {there['files']:,} files, {there['ratings']:,} ratings, {there['bytes'] / 1e6:,.1f} MB")
    print("it holds the secret behind people's links: keep it where only you can read it")


def _restore(arguments: argparse.Namespace) -> None:
    from onedemo.app.admin.backup import restore

    there = restore(arguments.file, arguments.data_dir)
    print(f"{arguments.data_dir}: {there['files']:,} files, {there['ratings']:,} ratings, links as they were")


def _doctor(arguments: argparse.Namespace) -> int:
    from onedemo.app.admin.doctor import examine

    wrong = 0
    for finding in examine(arguments.data_dir):
        wrong += not finding.ok
        print(f"{'ok  ' if finding.ok else 'BAD '} {finding.what:16} {finding.said}", flush=True)
    if wrong:
        print(f"{wrong} thing{'s' if wrong > 1 else ''} to look after")
    return int(wrong > 0)
