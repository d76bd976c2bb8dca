"""The quick form of the attack on the door, and what SECURITY.md says about tests."""

import re
from pathlib import Path

import check_door
import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.seam
@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::ResourceWarning")
def test_hostile_input_changes_nothing(tmp_path):
    findings = check_door.attack(tmp_path / "data", check_door.QUICK, seed=1)
    assert findings.broken == []
    assert findings.counts["messages"] == check_door.QUICK["messages"]
    assert findings.counts["requests"] == check_door.QUICK["requests"]
    assert findings.counts["sockets refused"] == 4 * check_door.PAGES_AT_ONCE
    assert findings.counts["answers 4xx"] > 50


def test_every_threat_names_a_test_that_exists():
    text = (ROOT / "SECURITY.md").read_text()
    rows = [line for line in text.splitlines() if line.startswith("| ") and "`tests/" in line]
    assert len(rows) > 15
    for file, name in re.findall(r"`(tests/\w+\.py)(?:::(\w+))?`", text):
        source = (ROOT / file).read_text()
        assert not name or f"def {name}(" in source, f"{file} has no {name}"
