"""The quick form of the attack on the door, and what SECURITY.md says about tests."""

import json
import os
import re
import subprocess
import sys

import pytest

from helpers.beside_playwright import run
from helpers.paths import ROOT, TESTS
from load import attack_http, attackers, fuzz_http


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


@pytest.mark.seam
def test_somebody_rates_while_strangers_attack(site):
    """Briefly, and with much patience: tests/load/attack_http.py, of ``make chaos``, measures."""
    site.trainer.add_clips(60)
    attacked = attack_http.Site(site.url, site.trainer.data_dir, site.trainer.store.path)
    found, broken = run(attack_http.attacked(attacked, list(attackers.KINDS), 200, 0.5, slack=8))
    assert not broken, attack_http.table(found)
    assert len(found) == 1 + len(attackers.KINDS)
    assert all(seen.next_clip_s and seen.health_s for seen in found)


def test_every_threat_names_a_test_that_exists():
    text = (ROOT / "SECURITY.md").read_text()
    rows = [line for line in text.splitlines() if line.startswith("| ") and "`tests/" in line]
    assert len(rows) > 15
    named = re.findall(r"`(tests/[\w/]+\.py)(?:::(\w+))?`", text)
    assert len(named) >= len(rows)
    for file, name in named:
        source = (ROOT / file).read_text()
        assert not name or f"def {name}(" in source, f"{file} has no {name}"
