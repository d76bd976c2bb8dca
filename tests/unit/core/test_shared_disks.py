"""Network file systems, and two computers on one directory."""

import json
import os
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest

from onedemo.core import shared_disks
from onedemo.core.files import hold
from onedemo.core.shared_disks import file_system, heartbeat, is_shared, refuse_if_elsewhere
from onedemo.errors import UserError
from onedemo.storage.store import Store

real = time.sleep
MOUNTS = """\
27 1 254:0 / / rw,relatime - ext4 /dev/vda rw
30 27 0:40 / /home rw - nfs4 server:/home rw
31 30 0:41 / /home/ann/usb\\040stick rw - exfat /dev/sda1 rw
32 27 0:42 / /mnt/lab rw,nosuid - fuse.sshfs lab:/data rw
33 27 0:43 / /mnt/lab rw - ext4 /dev/vdb rw
34 27 0:44 / /mnt/labor rw - cifs //lab/or rw
"""


@pytest.mark.parametrize(
    ("path", "kind"),
    [
        ("/var/x", "ext4"), ("/home/ann/data", "nfs4"), ("/home/ann/usb stick/data", "exfat"),
        ("/homes", "ext4"), ("/mnt/lab/data", "ext4"), ("/mnt/labor/data", "cifs"), ("/home", "nfs4"),
    ],
)  # fmt: skip
def test_the_kind_of_a_file_system(path, kind):
    assert file_system(Path(path), MOUNTS) == kind


def test_this_one_is_a_disk(tmp_path):
    assert file_system(Path("/proc")) == "proc" and not is_shared(tmp_path)


OTHER = """
import sys, time
from pathlib import Path
from onedemo.core import shared_disks
shared_disks._kernel = lambda: "another computer"
with shared_disks.heartbeat(Path(sys.argv[1]), every_s=0.1):
    print("alive", flush=True)
    sys.stdin.readline()
"""


def test_another_computer_at_work_is_noticed_and_one_that_died_is_not_waited_for(tmp_path):
    """Its lock is not seen, as over sshfs: only what it writes."""
    lock = tmp_path / "lock"
    lock.touch()
    refuse_if_elsewhere(lock, watch_s=60)  # nobody: at once
    command = [sys.executable, "-c", OTHER, str(lock)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None and other.stdout.readline() == "alive\n"
        with pytest.raises(UserError, match=rf"on the computer '{os.uname().nodename}'.*stop that one first"):
            refuse_if_elsewhere(lock, watch_s=60)
        other.kill()
    assert lock.stat().st_size > 0
    began = time.monotonic()
    refuse_if_elsewhere(lock, watch_s=0.5)
    assert time.monotonic() - began >= 0.5 and lock.stat().st_size == 0


def left_behind(lock, host="gone"):
    lock.parent.mkdir(parents=True, exist_ok=True)
    about = {"host": host, "kernel": "of another computer", "process": 7, "beat": 3}
    lock.write_text(json.dumps(about).ljust(300))


def test_what_ten_that_died_left_is_waited_for_once(tmp_path, monkeypatch):
    """Before, ten times; and again with every command."""
    locks = [tmp_path / "runs" / f"jump-{number}" / "lock" for number in range(10)]
    for lock in locks:
        left_behind(lock)
    slept = []
    monkeypatch.setattr(shared_disks, "WATCH_S", 0.5)
    monkeypatch.setattr("onedemo.storage.database.is_shared", lambda path: True)
    monkeypatch.setattr("onedemo.core.files.is_shared", lambda path: True)
    monkeypatch.setattr(shared_disks.time, "sleep", lambda seconds: slept.append(seconds) or real(seconds))
    with closing(Store(tmp_path)):
        assert 0.4 < sum(slept) < 1
        for lock in locks:
            with hold(lock):
                pass
    with closing(Store(tmp_path)):
        assert sum(slept) < 1


def test_of_several_the_one_that_is_alive_is_noticed(tmp_path, monkeypatch):
    locks = [tmp_path / f"{number}" / "lock" for number in range(3)]
    for lock in locks:
        left_behind(lock)
    monkeypatch.setattr(
        shared_disks.time, "sleep", lambda seconds: left_behind(locks[1], "alive") or real(0.01)
    )
    with pytest.raises(UserError, match=r"on the computer 'alive'.*works on .*/1, and"):
        refuse_if_elsewhere(*locks, watch_s=60)
    assert all(lock.stat().st_size for lock in locks)


def test_a_start_on_this_computer_meanwhile_is_not_another_computer(tmp_path, monkeypatch):
    lock = tmp_path / "lock"
    left_behind(lock)
    monkeypatch.setattr(
        shared_disks.time, "sleep", lambda seconds: shared_disks._write(lock, 0) or real(0.01)
    )
    refuse_if_elsewhere(lock, watch_s=0.2)
    assert lock.stat().st_size  # it is not taken out either


def test_this_computer_is_not_waited_for_and_cleans_up(tmp_path):
    lock = tmp_path / "lock"
    lock.touch()
    with heartbeat(lock):
        refuse_if_elsewhere(lock, watch_s=60)
    assert lock.stat().st_size == 0


def test_a_lock_on_a_network_file_system_is_written_into(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr("onedemo.core.files.is_shared", lambda path: True)
    with hold(tmp_path / "lock"):
        assert "only one computer at a time" in caplog.text
        with pytest.raises(UserError, match="another onedemo"), hold(tmp_path / "lock"):
            pass
        assert (tmp_path / "lock").stat().st_size  # who is refused leaves it as it is
