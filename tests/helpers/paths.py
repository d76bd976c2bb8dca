"""Where things lie in the repository, for tests."""

import os
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
ROOT = TESTS.parent
DEMOS = ROOT / "static" / "demos"
DATABASES = TESTS / "data" / "databases"
PERSON = Path(os.environ.get("ONEDEMO_PERSON_VIDEO") or "no-such-video.mp4")
"""A video of a real person, which is no part of the repository; tests that want it are skipped without."""
