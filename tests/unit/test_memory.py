"""Memory that is freed is kept for the next arrays, and only while it shall be."""

import ctypes
import json
import subprocess
import sys

import pytest

MB = 48

COUNTS = f"""
import ctypes, json, resource

from iscat_analysis.memory import freed_memory_kept


def cleared():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    room = ctypes.create_string_buffer({MB} * 2**20)
    ctypes.memset(room, 1, len(room))
    return (resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before) * resource.getpagesize()


before = [cleared(), cleared()]
with freed_memory_kept():
    within = [cleared(), cleared()]
print(json.dumps([before, within, cleared()]))
"""
"""Bytes that the system clears for one array after the other, in a process that freed no others."""


@pytest.mark.skipif(
    sys.platform != "linux" or not hasattr(ctypes.CDLL(None), "mallopt"),
    reason="not GNU's C library",
)
def test_freed_memory_is_kept_and_given_back_at_the_end() -> None:
    done = subprocess.run([sys.executable, "-c", COUNTS], check=True, capture_output=True)
    before, within, after = json.loads(done.stdout)
    assert min(*before, within[0], after) > MB / 2 * 2**20
    assert within[1] < MB / 10 * 2**20
