# SPDX-License-Identifier: Apache-2.0
"""Executors for one dive: this process, or a second one that imports and works meanwhile.

Threads share one lock, and Rerun's library takes longer to import than a dive to be read; a process
that starts with the dive has it ready when the tracks are.  Measured idle, that saves a quarter of
a run (24 h: 4.6 -> 3.5 s) and nothing in a batch, whose cores are busy.  `run` owns the executor;
the stages know `concurrent.futures.Executor` only.
"""

import os
import pickle
import select
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic
from typing import IO, Any, Final, ParamSpec, TypeVar

from abyssnav.errors import PipelineError
from abyssnav.startup import block_pandas_import, give_back_memory, tune_gc

Given = ParamSpec("Given")
Result = TypeVar("Result")

_SIZE: Final = struct.Struct("<Q")
#: Our own modules may lie in a checkout that is not installed; -P keeps those of the folder in
#: which a person types the command (a `numpy.py`, say) out.
_SERVE: Final = (
    "import sys; root = sys.argv.pop(1); root in sys.path or sys.path.insert(0, root); "
    "from abyssnav.second_process import serve; serve()"
)
#: No piece of work of one dive takes so long; what does hangs.
_TIMEOUT_S: Final = 3600.0


class InlineExecutor(Executor):
    """Does the work at once, in this process."""

    def submit(
        self, fn: Callable[Given, Result], /, *args: Given.args, **kwargs: Given.kwargs
    ) -> "Future[Result]":
        """Call `fn`; what it raises is raised here."""
        done = Future[Result]()
        done.set_result(fn(*args, **kwargs))
        return done


class SecondProcessExecutor(Executor):
    """The second process, as seen from here; one piece of work at a time, in order."""

    def __init__(self, process: "subprocess.Popen[bytes]", timeout_s: float = _TIMEOUT_S) -> None:
        self._process, self._timeout_s = process, timeout_s
        self._queue = ThreadPoolExecutor(1)
        self.peak_memory_mb = 0.0  #: of the second process, as of its last answer

    def submit(
        self, fn: Callable[Given, Result], /, *args: Given.args, **kwargs: Given.kwargs
    ) -> "Future[Result]":
        """Have it call a function of a module of ours; arrays travel without a second copy."""
        return self._queue.submit(self._call, fn, args, kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the process; it has nothing to lose, and would take long to clear up."""
        self._process.kill()
        self._queue.shutdown(wait, cancel_futures=cancel_futures)
        for stream in (self._process.stdin, self._process.stdout):
            with suppress(OSError):  # it may have ended before
                if stream is not None:
                    stream.close()
        self._process.wait()

    def _call(self, fn: Callable[..., Result], args: Any, kwargs: Any) -> Result:
        requests, answers = self._process.stdin, self._process.stdout
        assert requests is not None
        assert answers is not None
        try:
            _send(requests, (fn, args, kwargs))
            self._await(answers)
            result, failure, self.peak_memory_mb = _receive(answers)
        except (OSError, EOFError):
            status = self._process.wait()
            raise PipelineError(
                f"the second process ended with status {status}; "
                "is memory or the number of open files limited?"
            ) from None
        if failure is not None:
            raise failure
        answer: Result = result
        return answer

    def _await(self, answers: IO[bytes]) -> None:
        """Wait for the first byte of an answer, not for ever."""
        deadline = monotonic() + self._timeout_s
        while not select.select([answers], [], [], max(0.0, deadline - monotonic()))[0]:
            if monotonic() >= deadline:
                self._process.kill()
                raise PipelineError(
                    f"the second process gave no answer within {self._timeout_s:.0f} s"
                )


@contextmanager
def second_process(
    imports: Sequence[str], timeout_s: float = _TIMEOUT_S
) -> Iterator[SecondProcessExecutor]:
    """Start a process that imports modules and does work; it ends with the block.

    Parameters
    ----------
    imports : the first before all work, the others behind the first piece of it: this process reads
        a log meanwhile, with a thread for each core
    """
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", _SERVE, str(Path(__file__).parents[1]), *imports],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,  # what became of the work is told by its answer
        bufsize=0,  # what `select` says of the pipe must be true of the stream
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        start_new_session=True,  # an interrupt is for the first process
    )
    executor = SecondProcessExecutor(process, timeout_s)
    try:
        yield executor
    finally:
        executor.shutdown()


def serve() -> None:
    """Do what is asked on standard input until that ends."""
    from importlib import import_module

    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no answer
    tune_gc()
    first_import, other_imports = sys.argv[1:2], sys.argv[2:]
    with block_pandas_import(), suppress(EOFError, OSError):  # the first process is gone
        for name in first_import:
            import_module(name)
        while True:
            fn, args, kwargs = _receive(requests)
            result, failure = None, None
            try:
                result = fn(*args, **kwargs)
            except Exception as error:
                failure = error
            fn = args = kwargs = None  # the memory of a dive
            _send(answers, (result, failure, peak_memory_mb()))
            result = failure = None
            give_back_memory()
            while other_imports:
                import_module(other_imports.pop(0))


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far, in 10⁶ bytes.

    Linux's `ru_maxrss` begins with what the process had that started this one; VmHWM does not.
    """
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    except OSError:
        import resource

        unit_bytes = 1 if sys.platform == "darwin" else 1024
        return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit_bytes / 1e6, 1)
    entries = dict(line.split(":", 1) for line in status.splitlines())
    return round(float(entries["VmHWM"].split()[0]) * 1024 / 1e6, 1)


def _send(stream: IO[bytes], value: Any) -> None:
    """Number of parts, their sizes, the pickled value, its arrays' bytes."""
    arrays: list[pickle.PickleBuffer] = []
    head = pickle.dumps(value, protocol=5, buffer_callback=arrays.append)
    parts = [memoryview(head), *(array.raw() for array in arrays)]
    _write(stream, b"".join(_SIZE.pack(n) for n in (len(parts), *(part.nbytes for part in parts))))
    for part in parts:
        _write(stream, part)
    stream.flush()


def _write(stream: IO[bytes], content: "bytes | memoryview") -> None:
    """All of it: a stream without a buffer takes what fits."""
    rest = memoryview(content).cast("B")
    while len(rest):
        rest = rest[stream.write(rest) :]


def _receive(stream: IO[bytes]) -> Any:
    (n,) = _SIZE.unpack(_read_exactly(stream, _SIZE.size))
    sizes = struct.unpack(f"<{n}Q", _read_exactly(stream, n * _SIZE.size))
    head, *arrays = [_read_exactly(stream, size) for size in sizes]
    return pickle.loads(head, buffers=arrays)


def _read_exactly(stream: IO[bytes], size: int) -> bytearray:
    """So many bytes, in memory that an array may write to.

    Raises
    ------
    EOFError
        There are fewer.
    """
    content = bytearray(size)
    rest = memoryview(content)
    while rest:
        n = stream.readinto(rest)  # type: ignore[attr-defined]
        if not n:
            raise EOFError
        rest = rest[n:]
    return content
