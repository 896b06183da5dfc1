# SPDX-License-Identifier: Apache-2.0
"""A second process beside this one, that imports and works while this one has other things to do.

Threads share one lock and Rerun's library takes longer to import than a dive to be read; a process
that begins with the dive has it ready when the tracks are.
"""

import os
import pickle
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, Final, ParamSpec, TypeVar

from abyssnav.errors import PipelineError
from abyssnav.startup import collect_seldom, without_pandas

Given = ParamSpec("Given")
Made = TypeVar("Made")

_SIZE: Final = struct.Struct("<Q")
#: Our own modules may lie in a checkout that is not installed.
_SERVE: Final = (
    "import sys; root = sys.argv.pop(1); root in sys.path or sys.path.insert(0, root); "
    "from abyssnav.second_process import serve; serve()"
)


class Beside:
    """The other process, seen from here; one piece of work at a time, in order."""

    def __init__(self, process: "subprocess.Popen[bytes]", asker: ThreadPoolExecutor) -> None:
        self._process, self._asker = process, asker
        self.peak_memory_mb = 0.0  #: of the other process, as of its last answer

    def submit(
        self, work: Callable[Given, Made], *given: Given.args, **named: Given.kwargs
    ) -> "Future[Made]":
        """Have it call a function of a module of ours; arrays travel without being copied twice."""
        return self._asker.submit(self._ask, work, given, named)

    def _ask(self, work: Callable[..., Made], given: Any, named: Any) -> Made:
        to, back = self._process.stdin, self._process.stdout
        assert to is not None
        assert back is not None
        try:
            _send(to, (work, given, named))
            made, failure, self.peak_memory_mb = _receive(back)
        except (OSError, EOFError):
            told = self._process.wait()
            raise PipelineError(f"the process beside ended with status {told}") from None
        if failure is not None:
            raise failure
        answer: Made = made
        return answer


def later(
    beside: Beside | None, work: Callable[Given, Made], *given: Given.args, **named: Given.kwargs
) -> "Future[Made]":
    """What a function will have made in the other process, or has made here if there is none."""
    if beside is not None:
        return beside.submit(work, *given, **named)
    done = Future[Made]()
    done.set_result(work(*given, **named))
    return done


@contextmanager
def process_beside(imports: Sequence[str]) -> Iterator[Beside]:
    """Begin a process that imports some modules and then waits for work; it ends with the block."""
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", _SERVE, str(Path(__file__).parents[1]), *imports],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        start_new_session=True,  # an interrupt is this process's to hear
    )
    asker = ThreadPoolExecutor(1)
    try:
        yield Beside(process, asker)
    finally:
        process.kill()  # it has nothing to lose, and would take long to clear up
        asker.shutdown()
        for end in (process.stdin, process.stdout):
            with suppress(OSError):  # it may have ended before
                end and end.close()
        process.wait()


def serve() -> None:
    """Do what is asked on standard input until that ends."""
    from importlib import import_module

    ask, answer = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no answer
    collect_seldom()
    with without_pandas(), suppress(EOFError, OSError):  # who asked is gone
        for name in sys.argv[1:]:
            import_module(name)
        while True:
            work, given, named = _receive(ask)
            made, failure = None, None
            try:
                made = work(*given, **named)
            except Exception as error:
                failure = error
            work = given = named = None  # the memory of a dive
            _send(answer, (made, failure, peak_memory_mb()))


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
    told = dict(line.split(":", 1) for line in status.splitlines())
    return round(float(told["VmHWM"].split()[0]) * 1024 / 1e6, 1)


def _send(to: IO[bytes], value: Any) -> None:
    """Number of parts, their sizes, the pickled value, its arrays' bytes."""
    arrays: list[pickle.PickleBuffer] = []
    head = pickle.dumps(value, protocol=5, buffer_callback=arrays.append)
    parts = [memoryview(head), *(array.raw() for array in arrays)]
    to.write(b"".join(_SIZE.pack(n) for n in (len(parts), *(part.nbytes for part in parts))))
    for part in parts:
        to.write(part)
    to.flush()


def _receive(back: IO[bytes]) -> Any:
    (n,) = _SIZE.unpack(_exactly(back, _SIZE.size))
    sizes = struct.unpack(f"<{n}Q", _exactly(back, n * _SIZE.size))
    head, *arrays = [_exactly(back, size) for size in sizes]
    return pickle.loads(head, buffers=arrays)


def _exactly(back: IO[bytes], size: int) -> bytearray:
    """So many bytes, in memory that an array may write to.

    Raises
    ------
    EOFError
        There are fewer.
    """
    room = bytearray(size)
    if back.readinto(room) < size:  # type: ignore[attr-defined]
        raise EOFError
    return room
