"""Runs in parallel."""

from __future__ import annotations

import multiprocessing
import os
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from factorgraph_dvl.campaign.record import RunRecord


def in_two_processes(one, jobs):
    """Return what `one` makes of each job, in their order."""
    # One thread each: the two workers share two cores.
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(2, context) as pool:
            return list(pool.map(one, jobs))
    finally:
        if before is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = before


def sleepy_run(label, counts):
    """Return a record after half a second, and leave a file that it was begun."""
    begun = Path(counts, f"{label}.{os.getpid()}.{time.monotonic_ns()}")
    begun.touch()
    time.sleep(0.5)
    return RunRecord(name=label, fingerprint="", done=True)
