# SPDX-License-Identifier: Apache-2.0
"""What lies at a URL: of logs the bytes that the profile's topics need, and results, whole.

A log is copied into a file with holes: what lies in chunks without our topics is never fetched and
reads as zeros.  A file without an index, or with a damaged one, is fetched whole.

An object store cannot rename.  A result in one counts when its completion marker is there, which is
taken away before anything else is sent and sent after everything else.
"""

from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from time import sleep
from typing import Any, Final

from abyssnav.atomic import COMPLETION_MARKER
from abyssnav.errors import PipelineError, ReadError
from abyssnav.formats.mcap.file_index import Range, skippable_ranges, summary_start
from abyssnav.profile import Profile, Topics

#: Bytes asked for at the end of a file, where the summary of most is.
_TAIL: Final = 1 << 18
#: Pieces closer together than this are fetched as one: a request costs more.
_GAP: Final = 1 << 15
#: Pieces fetched at a time.
_TOGETHER: Final = 64
_PIECE: Final = 1 << 23
#: Between attempts at what a network or a server did not give.
_PAUSES_S: Final = (0.5, 2.0)
_PROBE: Final = ".abyssnav"


def is_url(place: str) -> bool:
    """Whether `place` is a URL, `s3://...` or `https://...`, and not a path."""
    return "://" in place


def logs_at(url: str) -> list[str]:
    """URLs of the MCAP files that a URL, a pattern in it, or a folder at it stands for.

    Raises
    ------
    ReadError
        Nothing there, or it cannot be reached.
    """

    def listed() -> list[str]:
        system, path = _opened(url)
        if any(sign in path for sign in "*?["):
            result = system.glob(path)
        elif system.isdir(path) and not path.endswith(".mcap"):
            result = [name for name in system.find(path) if name.endswith(".mcap")]
        else:
            return [url]
        return sorted(system.unstrip_protocol(name) for name in result)

    result: list[str] = _reaching(url, listed)
    if not result:
        raise ReadError(f"{url}: no .mcap file there")
    return result


def identity(url: str) -> str:
    """What changes when the file at a URL does: its tag, time or size, as the server tells."""

    def asked() -> str:
        system, path = _opened(url)
        return str(system.ukey(path))

    result: str = _reaching(url, asked)
    return result


def fetch(url: str, profile: Profile, target: Path) -> int:
    """Copy what is needed of the log at `url` into the file `target`.

    Returns
    -------
    fetched : bytes that were asked for

    Raises
    ------
    ReadError
        It is not there or cannot be reached.
    """
    topics = Topics(profile)

    def copied() -> int:
        system, path = _opened(url)
        before = system.ukey(path)
        count = _copy(system, path, topics, target)
        if system.ukey(path) != before:
            raise ReadError(f"{url}: changed while it was read; is it still being copied?")
        return count

    count: int = _reaching(url, copied)
    return count


@contextmanager
def local_logs(places: Sequence[str], profile: Profile) -> Iterator[list[Path]]:
    """Paths as they are, and of logs at URLs copies with what is needed of them.

    Raises
    ------
    PipelineError
        A URL is not there or cannot be reached; or whatever is raised meanwhile, which then names
        the URL.
    """
    with TemporaryDirectory(prefix="abyssnav-") as folder:
        paths, urls = list[Path](), dict[Path, str]()
        for place in places:
            for url in logs_at(place) if is_url(place) else ():
                paths.append(Path(folder) / PurePosixPath(url).name)
                urls[paths[-1]] = url
                fetch(url, profile, paths[-1])
            if not is_url(place):
                paths.append(Path(place))
        try:
            yield paths
        except PipelineError as refusal:  # whoever reads it knows the log by its URL
            text = str(refusal)
            for path, url in urls.items():
                text = text.replace(str(path), url)
            raise type(refusal)(text) from refusal


def _copy(system: Any, path: str, topics: Container[str], target: Path) -> int:
    """Bytes fetched into `target`: what is needed, or all where a server gives no parts."""
    size = system.size(path)
    with target.open("wb") as file:
        if size is not None:
            file.truncate(size)
            fetched = 0
            try:
                for (begin, _), piece in _needed(system, path, size, topics):
                    file.seek(begin)
                    file.write(piece)
                    fetched += len(piece)
            except NotImplementedError:  # a server that gives no parts of a file
                pass
            else:
                return fetched
    _trying_again(lambda: system.get_file(path, str(target)))
    whole = target.stat().st_size
    if size is not None and whole != size:
        raise ReadError(f"{path}: {size:,} bytes announced, {whole:,} sent")
    return whole


def content(url: str) -> bytes:
    """All bytes of the file at a URL.

    Raises
    ------
    ReadError
        It is not there or cannot be reached.
    """

    def whole() -> bytes:
        system, path = _opened(url)
        return bytes(system.cat_file(path))

    result: bytes = _reaching(url, whole)
    return result


def upload(folder: Path, url: str) -> None:
    """Copy the files of `folder` to below `url`, in the place of those that are there.

    The completion marker, if there is one, goes last; interrupted before, there is none at `url`.

    Raises
    ------
    ReadError
        `url` cannot be reached or written.
    """
    names = sorted(path.name for path in folder.iterdir() if path.is_file())

    def sent() -> None:
        system, place = _opened(url)
        if COMPLETION_MARKER in names and system.exists(f"{place}/{COMPLETION_MARKER}"):
            system.rm_file(f"{place}/{COMPLETION_MARKER}")
        for group in (
            [name for name in names if name != COMPLETION_MARKER],
            [n for n in names if n == COMPLETION_MARKER],
        ):
            if group:
                system.put([str(folder / n) for n in group], [f"{place}/{n}" for n in group])

    _reaching(url, sent)


def try_to_write(url: str) -> None:
    """Write and remove a file below `url`.

    Raises
    ------
    ReadError
        `url` cannot be reached or written.
    """

    def tried() -> None:
        system, place = _opened(url)
        system.pipe_file(f"{place}/{_PROBE}", b"may abyssnav write here?\n")
        system.rm_file(f"{place}/{_PROBE}")

    _reaching(url, tried)


def download(url: str, names: Sequence[str], folder: Path) -> None:
    """Copy the named files, their folders too, from below `url` to below `folder`.

    A file that is not there is left out.

    Raises
    ------
    ReadError
        It cannot be reached.
    """
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)

    def brought() -> None:
        system, place = _opened(url)

        def copy(wanted: Sequence[str]) -> None:
            system.get([f"{place}/{n}" for n in wanted], [str(folder / n) for n in wanted])

        try:
            copy(names)
        except FileNotFoundError:
            copy([name for name in names if system.exists(f"{place}/{name}")])

    if names:
        _reaching(url, brought)


def download_results(url: str, names: Sequence[str], folder: Path) -> None:
    """Copy the named files of the dives at a URL, one result or many, to below `folder`.

    A file that a dive does not have is left out.

    Raises
    ------
    ReadError
        No result there, or it cannot be reached.
    """

    def copied() -> int:
        system, place = _opened(url)
        one = system.exists(f"{place}/{COMPLETION_MARKER}")
        pattern = f"{place}/{COMPLETION_MARKER}" if one else f"{place}/*/{COMPLETION_MARKER}"
        dives = sorted(str(marker).rsplit("/", 1)[0] for marker in system.glob(pattern))
        for dive in dives:
            target = folder if one else folder / dive.rsplit("/", 1)[-1]
            target.mkdir(parents=True, exist_ok=True)
            present = {str(path).rsplit("/", 1)[-1] for path in system.ls(dive, detail=False)}
            wanted = [name for name in names if name in present]
            system.get([f"{dive}/{n}" for n in wanted], [str(target / n) for n in wanted])
        return len(dives)

    if not _reaching(url, copied):
        raise ReadError(f"{url}: holds no result of abyssnav run")


def _needed(
    system: Any, path: str, size: int, topics: Container[str]
) -> Iterator[tuple[Range, bytes]]:
    """Pieces of a file with their bytes, the summary first."""
    tail_from = max(0, size - _TAIL)
    (tail,) = _pieces(system, path, [(tail_from, size)])
    start = summary_start(tail, size)
    if start is not None and start < tail_from:
        (head,) = _pieces(system, path, [(start, tail_from)])
        tail, tail_from = head + tail, start
    yield (tail_from, size), tail
    holes = [] if start is None else skippable_ranges(tail[start - tail_from :], start, topics)
    spans = _between(holes, tail_from)
    for first in range(0, len(spans), _TOGETHER):
        together = spans[first : first + _TOGETHER]
        yield from zip(together, _pieces(system, path, together), strict=True)


def _pieces(system: Any, path: str, spans: Sequence[Range]) -> list[bytes]:
    """Bytes of some stretches of a file, each as long as asked for.

    Raises
    ------
    OSError
        They are not to be had, nor at the last attempt.
    """

    def asked() -> list[bytes]:
        starts, ends = [low for low, _ in spans], [high for _, high in spans]
        contents = system.cat_ranges([path] * len(spans), starts, ends, on_error="raise")
        for (low, high), content in zip(spans, contents, strict=True):
            if len(content) != high - low:
                raise OSError(f"{high - low:,} bytes asked for, {len(content):,} answered")
        return [bytes(content) for content in contents]

    pieces: list[bytes] = _trying_again(asked)
    return pieces


def _trying_again(attempt: Callable[[], Any]) -> Any:
    """What `attempt` gives, asked anew after a while where the network or a server failed."""
    for pause_s in _PAUSES_S:
        try:
            return attempt()
        except (FileNotFoundError, PermissionError, NotImplementedError, PipelineError):
            raise
        except Exception:  # each store has errors of its own; the last attempt's is said
            sleep(pause_s)
    return attempt()


def _between(holes: Sequence[Range], end: int) -> list[Range]:
    """Pieces of 0 ... `end` outside the holes, small holes filled, none too large."""
    edges = [0]
    for low, high in holes:
        if high - low > _GAP:
            edges += [low, high]
    edges.append(end)
    spans = [(low, high) for low, high in zip(edges[::2], edges[1::2], strict=True) if low < high]
    return [
        (begin, min(begin + _PIECE, high))
        for low, high in spans
        for begin in range(low, high, _PIECE)
    ]


def _opened(url: str) -> tuple[Any, str]:
    import fsspec.core

    if url.startswith(("http://", "https://")):
        from abyssnav.strict_http import StrictHTTPFileSystem

        return StrictHTTPFileSystem(), url
    # Listings that are remembered tell less of a file than asking for it does, and are soon old.
    options = {"auto_mkdir": True} if url.startswith("file:") else {}
    system, path = fsspec.core.url_to_fs(url, use_listings_cache=False, **options)
    return system, path


def _reaching(url: str, attempt: Callable[[], Any]) -> Any:
    """What `attempt` gives; whatever hinders it is one line."""
    try:
        return attempt()
    except ImportError as missing:
        raise PipelineError(
            f"{url}: a URL needs pip install 'abyssnav[cloud]' ({missing})"
        ) from None
    except PipelineError:
        raise
    except Exception as error:  # each store has errors of its own
        detail = " ".join(str(error).split()) or type(error).__name__
        raise ReadError(f"{url}: cannot be reached: {detail}") from None
