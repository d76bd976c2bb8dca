"""The command ``tidy``: pictures of runs that nobody waits for."""

from __future__ import annotations

from onedemo.app.cli.data import DATA, DataDir, open_store


def tidy(*, show: bool = False, data_dir: DataDir = DATA) -> None:
    """Deletes pictures of what is answered or has expired, also while the server runs.

    They are drawn again when somebody looks back at them. A server keeps to `storage.pictures_gb` by itself.

    Args:
        show: Only say how much could be freed.
    """
    from onedemo.storage.run_directory import RunDirectory
    from onedemo.training.pictures import awaited, pictures_of, tidy

    total = 0
    with open_store(data_dir, must_exist=True) as store:
        for entry in store.runs.all():
            files = RunDirectory(data_dir, entry["id"])
            there, keep = pictures_of(files), awaited(store, files)
            spare = sum(size for path, size, _ in there if path not in keep)
            freed = spare if show else tidy(store, files, 0)
            total += freed
            held = sum(size for _, size, _ in there) - (0 if show else freed)
            print(
                f"{files.run:24} {held / 1e6:8,.1f} MB of pictures{' now' if not show else ''}, "
                f"{freed / 1e6:,.1f} MB {'can be' if show else 'were'} freed"
            )
    print(f"{total / 1e6:,.1f} MB {'can be freed: run it without --show' if show else 'freed'}")
