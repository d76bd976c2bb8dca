"""Network file systems, and two computers on one directory."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from onedemo.core.files import hold
from onedemo.core.shared_disks import file_system, heartbeat, is_shared, refuse_if_elsewhere
from onedemo.errors import UserError

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
    assert time.monotonic() - began >= 0.5


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
