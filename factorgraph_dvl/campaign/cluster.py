"""Runs of a campaign on workers, by Dask: on this machine, or a cluster that is running."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from factorgraph_dvl.campaign.record import RunRecord
from factorgraph_dvl.errors import ConfigError

if TYPE_CHECKING:
    from distributed import Client

# Workers that may die over a run before it is given up. Chosen: Dask counts a death against
# what a worker had at hand, and its default of 3 ends good runs where workers are killed often.
_ALLOWED_FAILURES = 30
# Time for a scheduler to answer, s. Chosen: a slow network.
_TIMEOUT = 20

Run = tuple[Callable[..., RunRecord], tuple[Any, ...]]


def default_workers() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


@contextmanager
def connected(workers: int, scheduler: str | None) -> Iterator[Client]:
    """Yield a client of workers: so many on this machine, or those of a scheduler by address.

    Raises
    ------
    ConfigError
        If Dask is not installed, or no scheduler answers.
    """
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError:
        raise ConfigError(
            "Dask is not installed",
            where="campaign",
            expected="the extra `campaign`",
            hint="Install it by pip install 'factorgraph-dvl[campaign]'",
        ) from None
    dask.config.set(
        {
            "distributed.scheduler.allowed-failures": _ALLOWED_FAILURES,
            # A worker that dies takes nothing with it but what it was running.
            "distributed.scheduler.worker-saturation": 1.0,
            "distributed.comm.timeouts.connect": _TIMEOUT,
        }
    )
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=_TIMEOUT)
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"no scheduler answers ({error})",
                where=f"--scheduler {scheduler}",
                expected="the address of a Dask scheduler that is running, as tcp://host:8786",
            ) from None
        with client:
            _allow_failures(client)
            yield client
        return
    with (
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            # Trials are solved by processes of their own, whose memory no worker sees.
            memory_limit=0,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            silence_logs=logging.CRITICAL,
        ) as cluster,
        Client(cluster) as client,
    ):
        _leave_interrupts(client)
        yield client


def _leave_interrupts(client: Client) -> None:
    """Have workers leave Ctrl-C to this process, and to the solves that they started."""
    from distributed import WorkerPlugin

    class Uninterrupted(WorkerPlugin):  # type: ignore[misc]
        def setup(self, worker: Any) -> None:
            # What is ignored, programs that are started would ignore, too.
            signal.signal(signal.SIGINT, lambda *_: None)

    client.register_plugin(Uninterrupted())


def _allow_failures(client: Client) -> None:
    """Have a scheduler that is running bear with the deaths of workers."""

    # Nested, as the scheduler may not have this package.
    def allow(count: int, dask_scheduler: Any) -> None:
        dask_scheduler.allowed_failures = max(dask_scheduler.allowed_failures, count)

    client.run_on_scheduler(allow, _ALLOWED_FAILURES)


def records(
    client: Client, runs: Sequence[Run], labels: Sequence[str]
) -> Iterator[tuple[int, RunRecord]]:
    """Yield the number and the record of each run as it ends, also of those that fail.

    Parameters
    ----------
    client : Client
        Client of the workers.
    runs : sequence of tuple of (callable, tuple)
        Functions that return a record, and their arguments.
    labels : sequence of str
        Names of the runs.
    """
    from distributed import as_completed

    futures = {
        client.submit(function, *arguments, key=f"{label}-{i}", pure=False, retries=0): i
        for i, ((function, arguments), label) in enumerate(zip(runs, labels, strict=True))
    }
    for future in as_completed(futures):
        i = futures[future]
        error = future.exception()
        if error is None:
            yield i, future.result()
        else:
            text = f"{type(error).__name__}: {error}"
            yield i, RunRecord(name=labels[i], fingerprint="", done=False, error=text)
        future.release()
