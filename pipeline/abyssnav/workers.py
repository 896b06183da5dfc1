# SPDX-License-Identifier: Apache-2.0
"""A process for each piece of work, some at a time."""

import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing import forkserver
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Final, TypeVar

from abyssnav.errors import PipelineError
from abyssnav.startup import MALLOC_ENVIRONMENT
from abyssnav.version import __version__

Work = TypeVar("Work")
Made = TypeVar("Made")

#: Imported once by the server that every worker is forked from: 2 s saved a dive.
_PRELOADED: Final = ["abyssnav.run", "pandas", "pyarrow.parquet"]
#: The same where recordings are made: 57 MB of the server that the workers are forked from.
_VIEWER: Final = ["rerun", "rerun.blueprint"]
#: One thread each: the processes share the cores among themselves.  And a safe path: a `numpy.py`
#: in the folder in which a person types the command is not ours to import.
_ENVIRONMENT: Final = {
    "PYTHONSAFEPATH": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "ARROW_NUM_THREADS": "1",
    "ARROW_DEFAULT_MEMORY_POOL": "system",
    **MALLOC_ENVIRONMENT,
}
#: Memory of a dive beside its input, and times its input; of 24 h at most.  Measured: 200 MB for
#: 1 h (3 MB), 560 MB for 24 h (62 MB).  A log full of pictures is larger, its navigation is not.
_BASE_BYTES: Final = 250e6
_PER_INPUT: Final = 10.0
_MOST_BYTES: Final = 1.5e9
#: A scheduler has so long to answer; one whose workers are still being started, for those.
_ANSWER_WITHIN_S: Final = 10.0
_WORKERS_WITHIN_S: Final = 30.0


def run_in_processes(
    function: Callable[[Work], Made],
    pieces: Sequence[Work],
    jobs: int,
    *,
    recordings: bool = True,
) -> Iterator[tuple[Work, Made | str]]:
    """Each piece with what `function` made of it, as they are finished.

    Every piece has its own process, so that memory is given back and a piece that is killed (out of
    memory, a fault in a library) takes none of the others along: its result is the reason, a text.

    Parameters
    ----------
    recordings : whether pieces make recordings, for which the viewer's library is imported once
    """
    environment = {**_ENVIRONMENT, **os.environ}
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED + (_VIEWER if recordings else []))
    with _environment(environment):
        _start_forkserver()
    waiting = deque(pieces)
    running: dict[Any, tuple[BaseProcess, Work]] = {}  # by the pipe's end
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                ours, theirs = context.Pipe(duplex=False)
                arguments = (function, waiting[0], theirs, environment)
                worker = context.Process(target=_work, args=arguments)
                try:
                    with _environment(environment):  # a server that was killed starts again
                        worker.start()
                except (EOFError, OSError) as error:
                    detail = str(error) or "is memory or the number of open files limited?"
                    raise PipelineError(f"no worker process can be started: {detail}") from None
                theirs.close()
                running[ours] = (worker, waiting.popleft())
            for end in wait(list(running)):
                process, piece = running.pop(end)
                yield piece, _result(end, process)
    finally:
        for process, _ in running.values():
            process.terminate()
        for process, _ in running.values():
            process.join()


@contextmanager
def _environment(environment: Mapping[str, str]) -> Iterator[None]:
    """What a server inherits as it starts; whoever called keeps the environment that he had."""
    added = environment.keys() - os.environ.keys()
    os.environ.update({name: environment[name] for name in added})
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)


def _start_forkserver() -> None:
    """Start it deaf to interrupts, which are for this process, and mute: its tracebacks are.

    What becomes of a worker is told by its answer, or by how it ended.
    """
    before = signal.signal(signal.SIGINT, signal.SIG_IGN) if _in_main_thread() else None
    stderr, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        forkserver.ensure_running()
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(nowhere)
        if before is not None:
            signal.signal(signal.SIGINT, before)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def run_on_dask(
    function: Callable[[Work], Made],
    pieces: Sequence[Work],
    scheduler: str,
    jobs: int,
    paths: Sequence[str] = (),
) -> Iterator[tuple[Work, Made | str]]:
    """Like `run_in_processes`, by the workers of a Dask cluster; pieces of lost workers are redone.

    Parameters
    ----------
    scheduler : its address; empty for a cluster of `jobs` processes on this machine
    paths : files that every worker must see

    Raises
    ------
    PipelineError
        Dask is not installed, no scheduler answers, no worker comes, or one of them has not this
        version of ours or does not see the files.
    """
    try:
        import distributed
    except ModuleNotFoundError as missing:
        raise PipelineError(f"Dask needs pip install 'abyssnav[cluster]' ({missing})") from None
    dask: Any = distributed  # it is not typed
    with ExitStack() as stack:
        try:
            cluster = scheduler or stack.enter_context(
                dask.LocalCluster(n_workers=jobs, threads_per_worker=1, dashboard_address=None)
            )
            client = stack.enter_context(dask.Client(cluster, timeout=_ANSWER_WITHIN_S))
        except OSError as error:
            detail = " ".join(str(error).split())
            raise PipelineError(f"{scheduler}: no Dask scheduler answers: {detail}") from None
        _refuse_unfit_workers(client, scheduler or "the local cluster", paths)
        # A dive is not a function of its task alone: the file behind it may have changed.
        futures = {client.submit(function, piece, pure=False): piece for piece in pieces}
        for future in dask.as_completed(list(futures)):
            # Dask does again what a lost worker had made, as long as somebody holds the future.
            piece, failure = futures.pop(future), future.exception()
            reason = f"{type(failure).__name__}: {' '.join(str(failure).split())}"
            made = reason if failure else future.result()
            future.release()
            yield piece, made


def _refuse_unfit_workers(client: Any, scheduler: str, paths: Sequence[str]) -> None:
    """Ask the workers before they are given work: an unfit one would hang, or mix results."""
    try:
        client.wait_for_workers(1, timeout=_WORKERS_WITHIN_S)
    except TimeoutError:
        raise PipelineError(
            f"{scheduler}: no Dask worker within {_WORKERS_WITHIN_S:.0f} s"
        ) from None
    # Functions of ours travel by name, which a worker without the package cannot look up.
    version = "__import__('abyssnav').__version__"
    unseen = f"[p for p in {list(paths)!r} if not __import__('os').path.exists(p)]"
    for worker, answer in client.run(eval, version, on_error="return").items():
        if isinstance(answer, BaseException):
            raise PipelineError(f"Dask worker {worker} cannot import abyssnav: {answer}")
        if answer != __version__:
            raise PipelineError(f"Dask worker {worker} has abyssnav {answer}, not {__version__}")
    for worker, answer in client.run(eval, unseen).items():
        if answer:
            raise PipelineError(f"Dask worker {worker} does not see {answer[0]}")


def jobs_for(largest_input_bytes: int) -> int:
    """Processes that the cores and the free memory carry."""
    free_bytes = _free_memory_bytes()
    need_bytes = min(_BASE_BYTES + _PER_INPUT * largest_input_bytes, _MOST_BYTES)
    return max(1, min(cores(), int(free_bytes / need_bytes)))


def cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def _free_memory_bytes() -> float:
    if sys.platform != "linux":
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")) / 2
    with open("/proc/meminfo", encoding="ascii") as file:
        entries = dict(line.split(":") for line in file)
    return float(entries["MemAvailable"].split()[0]) * 1024


class _Terminated(BaseException):
    """SIGTERM, as an exception: a worker still clears up behind itself."""


def _end(*_: object) -> None:
    raise _Terminated


def _work(
    function: Callable[[Work], Made],
    piece: Work,
    answer: Connection,
    environment: Mapping[str, str],
) -> None:
    os.environ.update(environment)  # that of the forkserver is as old as its first batch
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt is the parent's to hear
    signal.signal(signal.SIGTERM, _end)
    try:
        with suppress(OSError):  # who asked is gone
            answer.send(function(piece))
    except _Terminated:  # all is cleared up: now it ends as who sent the signal expects
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGTERM)
    answer.close()


def _result(answer: Any, worker: BaseProcess) -> Any:
    try:
        made: Any = answer.recv()
    except EOFError:
        worker.join()
        code = worker.exitcode or 0
        made = f"its process ended with status {code}"
        if code < 0:
            memory = "; out of memory?" if -code == signal.SIGKILL else ""
            made = f"its process was ended by {signal.Signals(-code).name}{memory}"
    answer.close()
    worker.join()
    return made
