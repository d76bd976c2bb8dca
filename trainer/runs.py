"""Making a run, or finding the one to go on with."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

from trainer.config import RunConfig, load_config, to_toml
from trainer.errors import UserError
from trainer.files import write_atomic
from trainer.records import Demo
from trainer.store import Store


def program_version() -> str:
    """The installed version of onedemo."""
    return version("onedemo")


def open_run(
    store: Store, data_dir: Path, demo: Demo, config: RunConfig, *, name: str | None, resume: bool
) -> tuple[str, RunConfig]:
    """The run to work on: an earlier one where that is wanted and there is one, else a new one.

    Args:
        store: Where runs are recorded.
        data_dir: A new run's ``runs/<name>/config.toml`` is written in it.
        demo: What is to be learned.
        config: Settings of a new run; an earlier run must have the same.
        name: Which run, or None: the newest of this demo, or a new one called ``<demo>-<number>``.
        resume: Go on with an earlier run if there is one.

    Returns:
        The run's name and its settings.

    Raises:
        UserError: If the earlier run has other settings or another demo, or the name is taken.
    """
    runs = store.runs()
    found = [r for r in runs if (r["id"] == name if name else r["demo"] == demo.name)]
    if resume and found:
        run = found[-1]
        if run["demo_sha256"] != demo.sha256:
            raise UserError(
                f"run {run['id']!r} was made with another video than demo {demo.name!r} is now; "
                "start a new run with --new-run"
            )
        file = data_dir / "runs" / run["id"] / "config.toml"
        if not file.exists():  # lost with the directory; the database has it too
            write_atomic(file, run["config"].encode())
        if load_config(file) != config:
            raise UserError(
                f"run {run['id']!r} has other settings than those given (see {file}); "
                "use the same, or start a new run with --new-run"
            )
        return run["id"], config
    taken = {r["id"] for r in runs}
    number = 1
    while name is None:
        candidate = f"{demo.name}-{number}"
        name = candidate if candidate not in taken else None
        number += 1
    text = to_toml(config)
    store.add_run(
        run=name, demo=demo.name, demo_sha256=demo.sha256, seed=config.seed, config=text,
        version=program_version(),
    )  # fmt: skip
    write_atomic(data_dir / "runs" / name / "config.toml", text.encode())
    return name, config
