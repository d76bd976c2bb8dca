"""One job of a study in a process of its own: ``python -m onedemo.experiments.worker REQUEST``.

REQUEST is JSON, as ``onedemo.experiments.runner`` makes it. The result is written to its file only when the
job has finished; whatever else it writes goes into a scratch directory that is removed at the end.
Standard input is a lifeline: when it ends, so does this process, for the study behind it has gone,
however it went.
"""

from __future__ import annotations

import importlib
import inspect
import json
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from onedemo.core.files import write_atomic
from onedemo.core.process import prepare_process
from onedemo.experiments.report.document import plain
from onedemo.experiments.report.machine import machine, now, program


def main(request_json: str) -> None:
    """Does the job and writes its result."""
    request = json.loads(request_json)
    file = Path(request.pop("file"))
    file.parent.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix=f".{file.stem}-", dir=file.parent))
    threading.Thread(target=_end_with_parent, args=(scratch,), daemon=True).start()
    source = program()  # before the work: somebody may edit meanwhile
    try:
        run = find_function(request.pop("function"))
        cache = Path(request.pop("cache"))
        places = {"cache": cache} if "cache" in inspect.signature(run).parameters else {}
        began, began_cpu = time.monotonic(), time.process_time()
        result = run(request["settings"], request["seed"], scratch, **places)
        wall_s, cpu_s = time.monotonic() - began, time.process_time() - began_cpu
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    kept = {
        **request,
        **source,
        "date": now(),
        "wall_s": round(wall_s, 2),
        "cpu_s": round(cpu_s, 2),
        "load_average": [round(load, 2) for load in os.getloadavg()],
        "machine": machine(),
        "result": plain(result),
    }
    write_atomic(file, (json.dumps(kept, allow_nan=False) + "\n").encode())


def find_function(name: str) -> Callable[..., Mapping[str, Any]]:
    """The function that "module:function" names."""
    module, _, function = name.partition(":")
    return getattr(importlib.import_module(module), function)


def _end_with_parent(scratch: Path) -> None:
    os.read(sys.stdin.fileno(), 1)  # nothing is ever written there: this returns at its end
    shutil.rmtree(scratch, ignore_errors=True)
    os.killpg(0, signal.SIGKILL)  # the group is this process and what it started


if __name__ == "__main__":
    prepare_process()
    main(sys.argv[1])
