"""Drawing in a process of its own: what it draws, what goes wrong in it, and how it ends."""

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import CancelledError
from functools import partial

import numpy as np
import pytest

from helpers.paths import ROOT
from onedemo.errors import UserError
from onedemo.render.drawing_process import DrawingProcess
from onedemo.render.renderer import Renderer

pytestmark = pytest.mark.seam

STANDING = np.array([[0.0, 1.25, 0.0, 0.0, 0.0, 0.0]])


def refuse(renderer):
    raise UserError("no such thing")


def size(renderer):
    return renderer.width, renderer.height


def nothing_to_send(renderer):
    return lambda: 0


class TwoFold(Exception):
    """Is pickled with its text alone, of which it cannot be made again."""

    def __init__(self, one, other):
        super().__init__(f"{one} and {other}")


def raise_two_fold(renderer):
    raise TwoFold("this", "that")


class Unreadable:
    """Is pickled, and raises when it is read."""

    def __reduce__(self):
        return refuse, (None,)


def unreadable(renderer):
    return Unreadable()


@pytest.fixture(scope="module")
def drawing():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(
            "PYTHONPATH", os.pathsep.join((str(ROOT), str(ROOT / "tests")))
        )  # the process takes nothing from the current directory
        with DrawingProcess() as process:
            yield process


def test_it_draws_what_the_renderer_of_this_process_would(drawing):
    with Renderer(exact=False) as here:
        wanted = here.render(STANDING)
    drawn = drawing.submit(partial(Renderer.render, qpos_Tq=STANDING)).result(120)
    assert np.array_equal(drawn, wanted)


def test_what_goes_wrong_there_is_raised_here_and_the_next_job_is_done(drawing):
    with pytest.raises(UserError, match="no such thing"):
        drawing.submit(refuse).result(120)
    with pytest.raises(RuntimeError, match="nothing_to_send"):
        drawing.submit(nothing_to_send).result(120)
    assert drawing.submit(size).result(120) == (480, 360)


def test_an_error_that_cannot_be_read_again_is_told_in_words(drawing):
    before = drawing.pid
    with pytest.raises(RuntimeError, match="this and that"):
        drawing.submit(raise_two_fold).result(120)
    assert drawing.submit(size).result(120) == (480, 360) and drawing.pid == before


def test_after_an_answer_that_cannot_be_read_another_process_takes_over(drawing):
    before = drawing.pid
    with pytest.raises(RuntimeError, match="ended with code"):
        drawing.submit(unreadable).result(120)
    assert drawing.submit(size).result(120) == (480, 360) and drawing.pid != before


def test_a_process_that_dies_fails_its_jobs_and_another_takes_over(drawing):
    before = drawing.pid
    os.kill(before, signal.SIGSTOP)
    lost = [drawing.submit(size) for _ in range(3)]
    os.kill(before, signal.SIGKILL)
    for future in lost:
        assert isinstance(future.exception(60), RuntimeError)
    assert drawing.submit(size).result(120) == (480, 360) and drawing.pid != before


def test_closing_cancels_what_waits_even_if_the_process_hangs(monkeypatch):
    from onedemo.render import drawing_process

    monkeypatch.setattr(drawing_process, "_ENDING_S", 0.2)
    process = DrawingProcess()
    os.kill(process.pid, signal.SIGSTOP)
    waits = process.submit(size)
    process.close()
    with pytest.raises(CancelledError):
        waits.result(0)
    with pytest.raises(RuntimeError, match="closed"):
        process.submit(size)


def test_it_ends_with_the_program_however_that_ends():
    code = (
        "import time\nfrom onedemo.render.drawing_process import DrawingProcess\n"
        "print(DrawingProcess().pid, flush=True)\ntime.sleep(600)"
    )
    program = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    try:
        assert program.stdout is not None
        child = int(program.stdout.readline())
        os.kill(child, 0)
    finally:
        program.kill()
        program.communicate()
    end = time.monotonic() + 60
    while _runs(child):
        assert time.monotonic() < end, "it has outlived its program"
        time.sleep(0.05)


def _runs(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
