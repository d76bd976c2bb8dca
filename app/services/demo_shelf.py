"""Renaming and removing demos, with an eye on the runs that learn from them: for the command and the page."""

from __future__ import annotations

from pathlib import Path

from onedemo.demos.library import find_demo, remove_demo, rename_demo
from onedemo.errors import UserError
from onedemo.storage.store import Store


def runs_of(store: Store | None, sha256: str) -> list[str]:
    """The runs that learn from a demo, oldest first."""
    known = [] if store is None else store.runs.all()
    return [run["id"] for run in known if run["demo_sha256"] == sha256]


def rename(store: Store | None, data_dir: Path, old: str, new: str) -> None:
    """Gives a demo another name; its runs go on.

    Args:
        store: The database; None if there is none.
        data_dir: Everything is kept there.
        old: Its name.
        new: What to call it.

    Raises:
        UserError: As ``rename_demo``, or if there is no such demo.
    """
    found = find_demo(old, data_dir / "demos")
    rename_demo(found, new, data_dir / "demos")
    if store is not None:
        store.runs.rename_demo(found.sha256, new)


def remove(store: Store | None, data_dir: Path, name: str) -> None:
    """Deletes a demo that no run learns from.

    Raises:
        UserError: If one does, or it came with the program, or there is no such demo.
    """
    found = find_demo(name, data_dir / "demos")
    if runs := runs_of(store, found.sha256):
        raise UserError(
            f"the demo {name} is what {_named(runs)} from, and could not go on without it; if its name is "
            f"wanted, give it another: onedemo demo rename {name} NEW"
        )
    remove_demo(found, data_dir / "demos")


def _named(runs: list[str]) -> str:
    shown = ", ".join(runs[:3]) + (f" and {len(runs) - 3} more" if len(runs) > 3 else "")
    return f"run {shown} learns" if len(runs) == 1 else f"runs {shown} learn"
