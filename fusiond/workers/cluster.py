"""Runner on the workers of a Dask scheduler (extra `[cluster]`).

Each thread of a Dask worker has a `Pool` of one process: a run that kills its process or never ends
is an outcome here, too, and no Dask worker is lost. Dask handles the death of its workers: their
chunks go to another one, and only a chunk that has brought down several
(`distributed.scheduler.allowed-failures`) is given up. Every worker needs the same version of
fusiond and the same files under the same paths.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from fusiond.workers.pool import Pool
from fusiond.workers.runner_interface import Outcome, R, T

CONNECT_S = 10.0
"""Time (s) for the connection: Dask's own default."""
_THIS_THREAD = threading.local()


class ClusterError(Exception):
    """Error: no scheduler answers, or Dask is not installed."""


class Cluster:
    """Runner on the workers of the scheduler at `address`; an item may take `timeout_s`.

    Raises `ClusterError`.
    """

    def __init__(
        self, address: str, timeout_s: float | None = None, connect_s: float = CONNECT_S
    ) -> None:
        try:
            from distributed import Client  # noqa: PLC0415  (extra `[cluster]`)
        except ImportError as error:
            raise ClusterError("--cluster needs Dask, which is not installed") from error
        try:
            self._client: Any = Client(address, timeout=connect_s, set_as_default=False)
        except (OSError, ValueError) as error:
            raise ClusterError(f"{address}: no Dask scheduler answers: {error}") from error
        self._timeout_s = timeout_s

    @property
    def workers(self) -> int:
        """Number of threads of all workers."""
        threads: dict[str, int] = self._client.nthreads()
        return max(1, sum(threads.values()))

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()

    def outcomes(
        self, work: Callable[[T], R], items: Sequence[T], chunk: int = 1
    ) -> Iterator[Outcome[R]]:
        """Outcomes of `items`, as in `Runner`."""
        from distributed import as_completed  # noqa: PLC0415

        firsts = {
            self._client.submit(
                _work_off, work, items[first : first + chunk], self._timeout_s, pure=False
            ): first
            for first in range(0, len(items), chunk)
        }
        for future in as_completed(list(firsts), loop=self._client.loop):
            first = firsts.pop(future)
            error = future.exception()
            if error is None:
                for o in future.result():
                    yield Outcome(first + o.index, o.ended, o.reason, o.result)
                continue
            for index in range(first, min(first + chunk, len(items))):
                yield Outcome(index, "died", f"given up by the cluster: {error}")


def _work_off(
    work: Callable[[T], R], items: Sequence[T], timeout_s: float | None
) -> list[Outcome[R]]:
    """Run items in a thread of a Dask worker."""
    pool = getattr(_THIS_THREAD, "pool", None)
    if pool is None or pool.timeout_s != timeout_s:
        pool = _THIS_THREAD.pool = Pool(1, timeout_s)
    return list(pool.outcomes(work, items, len(items)))
