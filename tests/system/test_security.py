"""The quick form of the attack on the door, and what SECURITY.md says about tests."""

import json
import os
import re
import subprocess
import sys

import pytest

from helpers.paths import ROOT, TESTS
from load import fuzz_http


@pytest.mark.seam
def test_hostile_input_changes_nothing(tmp_path):
    """In a process of its own: what it says of memory, threads and files is then of the server alone."""
    told = tmp_path / "told.json"
    command = [sys.executable, fuzz_http.__file__, "--quick", "--seed", "1", "--json", str(told)]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {"PYTHONPATH": str(TESTS)}, capture_output=True)
    assert done.returncode == 0, done.stdout.decode() + done.stderr.decode()[-2000:]
    found = json.loads(told.read_text())
    assert found["broken"] == []
    assert found["messages"] == fuzz_http.QUICK["messages"]
    assert found["requests"] == fuzz_http.QUICK["requests"]
    assert found["sockets refused"] == 4 * fuzz_http.PAGES_AT_ONCE
    assert found["answers 4xx"] > 50


def test_every_threat_names_a_test_that_exists():
    text = (ROOT / "SECURITY.md").read_text()
    rows = [line for line in text.splitlines() if line.startswith("| ") and "`tests/" in line]
    assert len(rows) > 15
    named = re.findall(r"`(tests/[\w/]+\.py)(?:::(\w+))?`", text)
    assert len(named) >= len(rows)
    for file, name in named:
        source = (ROOT / file).read_text()
        assert not name or f"def {name}(" in source, f"{file} has no {name}"
