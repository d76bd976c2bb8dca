"""A segment as bytes, the way the database keeps it: a NumPy file (NPY) of W records.

Each record holds one control step. The header names the arrays, their types and their widths, so the
file explains itself and NumPy alone reads it: ``np.load(io.BytesIO(data), allow_pickle=False)["obs"]``.
"""

from __future__ import annotations

import io
from functools import lru_cache

import numpy as np

from onedemo.types import Segment

_NAMES = ("obs", "actions", "qpos", "qvel")
_ZIP = b"PK"


def pack_segment(segment: Segment) -> bytes:
    """A segment as the bytes of an NPY file; every array keeps its type."""
    arrays = {name: getattr(segment, name) for name in _NAMES}
    records = np.empty(len(segment), [(name, a.dtype, a.shape[1:]) for name, a in arrays.items()])
    for name, array in arrays.items():
        records[name] = array
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, records, version=(1, 0), allow_pickle=False)
    return buffer.getvalue()


def unpack_segment(data: bytes) -> Segment:
    """The reverse of ``pack_segment``; also reads NPZ, as in databases that began with schema 1.

    Returns:
        A segment whose arrays cannot be written to.

    Raises:
        ValueError: If the bytes are neither.
    """
    if data.startswith(_ZIP):
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            return Segment(**{name: arrays[name] for name in _NAMES})
    # NumPy's own reader parses the header as Python source each time, 100 us; it is nearly always the same.
    start = 10 + int.from_bytes(data[8:10], "little")
    length, dtype = _header(data[:start])
    records = np.frombuffer(data, dtype, length, start)
    return Segment(**{name: records[name] for name in _NAMES})


@lru_cache(maxsize=64)
def _header(data: bytes) -> tuple[int, np.dtype]:
    buffer = io.BytesIO(data)
    if np.lib.format.read_magic(buffer) != (1, 0):
        raise ValueError("a segment is an NPY file of version 1.0")
    (length,), _, dtype = np.lib.format.read_array_header_1_0(buffer)
    return length, dtype
