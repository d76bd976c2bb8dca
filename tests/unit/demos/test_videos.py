"""Every kind of video of ``tests/data/videos.py``, decoded in one process with the limits of the real one."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest
from data.videos import KINDS, at_rate, jittered, number_of

from helpers.paths import ROOT
from onedemo.demos.resampling import resample
from onedemo.demos.source import Source

pytestmark = pytest.mark.seam

SHORT = [kind for kind in KINDS if not kind.long]

_DECODE = """
import json, os, sys
from pathlib import Path
import av, cv2, io
from data.videos import KINDS, wrong
from onedemo.demos import decoder_child
from onedemo.demos.containers import check_file
from onedemo.demos.import_checks import StoredCheck
from onedemo.demos.edits import Options
from onedemo.demos.sandboxed_decoder import Limits
from onedemo.errors import UserError

av.logging.set_level(None)
directory = Path(sys.argv[1])
files = {}
for kind in KINDS:
    path = directory / kind.file
    if kind.long:
        continue
    try:
        check_file(path)
        files[kind.file] = path.open("rb")
    except UserError as error:
        print(json.dumps([kind.file, str(error)]), flush=True)
sum(1 for _ in decoder_child.shaped_frames(io.BytesIO(decoder_child._TINY), "", Options()))
decoder_child._limit(Limits().memory, Limits().cpu_seconds)
for kind in KINDS:
    if kind.file not in files:
        continue
    check = StoredCheck()
    try:
        frames = [check.given(frame) for frame in decoder_child.shaped_frames(
            files[kind.file], kind.file, Options(**kind.options))]
        check.check_pictures(kind.file)
        said = wrong(kind, frames) or "as expected"
    except UserError as error:
        said = str(error)
    print(json.dumps([kind.file, said]), flush=True)
os._exit(0)
"""


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    """What came of each file."""
    directory = tmp_path_factory.mktemp("videos")
    for kind in SHORT:
        kind.make(directory / kind.file)
    done = subprocess.run(
        [sys.executable, "-c", _DECODE, str(directory)],
        cwd=ROOT / "tests",
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return dict(json.loads(line) for line in done.stdout.splitlines())


@pytest.mark.parametrize("kind", SHORT, ids=lambda kind: kind.file)
def test_it_shows_what_it_should_or_says_why_not(outcomes, kind):
    said = outcomes[kind.file]
    assert re.search(kind.refused or "^as expected$", said), said


@pytest.mark.parametrize(
    ("rate", "within"),
    [
        (30, 0.0005),
        (30, 0.001),
        (30, 0.002),
        (30, 0.004),
        (30, 0.008),
        (29.97, 0.004),
        (30, 0),
    ],
)
@pytest.mark.parametrize("start", [0.0, 1.0, 1.51])
def test_no_frame_is_doubled_or_lost_where_stamps_jitter_about_the_rate(rate, within, start):
    shown = []
    for seed in range(5):
        stamps = enumerate(jittered(300, rate, within, seed))
        shown = list(
            resample(((at, i) for i, at in stamps), fps=30, lasts=lambda: 1 / 30, start=start, end=np.inf)
        )
        assert shown == list(range(shown[0], 300)), seed
        assert abs(shown[0] - start * 30) < 1


@pytest.mark.parametrize(("rate", "fps"), [(60, 30), (120, 30), (60, 20), (15, 30), (30, 60), (30, 15)])
def test_whole_ratios_stay_even_where_stamps_jitter(rate, fps):
    within = 0.22 * min(1 / rate, 1 / fps)
    for seed in range(5):
        stamped = ((at, i) for i, at in enumerate(jittered(120, rate, within, seed)))
        shown = list(resample(stamped, fps=fps, lasts=lambda: 1 / rate, start=0.0, end=np.inf))
        assert shown == at_rate(120, rate, fps), seed


def test_a_part_far_from_the_start_is_sought(tmp_path):
    """5 s of an hour are had in a second; all before it were decoded, which took too long."""
    (kind,) = [kind for kind in KINDS if kind.file == "ten-minutes.mp4"]
    kind.make(tmp_path / kind.file)
    with (tmp_path / kind.file).open("rb") as file, Source(file, kind.file) as source:
        shown = source.frames(590.0)
        first = next(shown)
        assert 584 < first.seconds <= 590 and number_of(first.picture()) == round(first.seconds * 10) % 1000
        assert sum(1 for _ in shown) < 160
