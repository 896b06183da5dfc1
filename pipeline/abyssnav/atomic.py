# SPDX-License-Identifier: Apache-2.0
"""Output folders that appear whole or not at all, whatever ends the process."""

import errno
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.parse import quote

from abyssnav.errors import PipelineError

#: A folder with this file is a whole result of ours: it is written last.
COMPLETION_MARKER = "summary.json"
_FLUSHED_AT_ONCE = 8


@contextmanager
def atomic_directory(folder: Path) -> Iterator[Path]:
    """Folder to write into that takes the place of `folder` when all went well.

    It lies beside `folder`, is flushed to the disk and then renamed; an older result stays until
    that moment.  After an error `folder` is as it was.  What a killed process left behind is
    cleared by the next one.

    Raises
    ------
    PipelineError
        `folder` is something else than a result of ours, or cannot be written.
    """
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        clear_leftovers(folder)
        if os.path.lexists(folder) and not (folder / COMPLETION_MARKER).is_file():
            raise PipelineError(f"{folder}: exists and is no result of abyssnav; not replaced")
        with locked_folder_beside(folder) as fresh:
            yield fresh
            _flush(fresh)
            _replace(folder, fresh)
    except OSError as error:
        place = error.filename or folder
        raise PipelineError(f"{place}: cannot be written: {error.strerror or error}") from None


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """File to write that takes the place of `path` when all went well.

    Raises
    ------
    PipelineError
        `path` cannot be written.
    """
    from filelock import lock_descriptor

    fresh = _fresh_name(path)
    handle = -1
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _clear_parts(path)
        handle = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        lock_descriptor(handle)
        yield fresh
        _sync(fresh)
        fresh.replace(path)
        _sync(path.parent)
    except OSError as error:
        raise PipelineError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        fresh.unlink(missing_ok=True)
        if handle >= 0:
            os.close(handle)


def keep_foreign_files(folder: Path, fresh: Path) -> list[str]:
    """Copy into `fresh` what an older result holds and this one does not make.

    Exports, figures and notes that people put beside a result survive its replacement; the names
    are for telling them that these were made of the older one.

    Returns
    -------
    names : of the files and folders that were kept, sorted
    """
    if not folder.is_dir():
        return []
    kept = sorted(entry for entry in folder.iterdir() if not (fresh / entry.name).exists())
    for entry in kept:
        if entry.is_dir() and not entry.is_symlink():
            shutil.copytree(entry, fresh / entry.name, symlinks=True)
        else:
            shutil.copy2(entry, fresh / entry.name, follow_symlinks=False)
    return [entry.name for entry in kept]


def folder_name(text: str) -> str:
    """Name of a folder that holds what is called `text`: itself, but for what no folder can bear.

    Bytes that are no UTF-8 and letters that cannot be printed become %XX, as do the dots of `.`
    and `..` and of names that begin with one: those would be hidden, or another folder.  Nothing
    becomes `%`.
    """
    printable = "".join(
        letter
        if letter.isprintable() and letter not in "/\\"
        else quote(os.fsencode(letter), safe="")
        for letter in text
    )
    if printable.startswith("."):
        printable = "%2E" + (printable[1:] if printable.strip(".") else "%2E" * len(text[1:]))
    return printable or "%"


def clear_leftovers(folder: Path) -> None:
    """Undo what a process killed while it wrote `folder` left beside it.

    Raises
    ------
    OSError
        The parent of `folder` cannot be read or changed.
    """
    if _old(folder).exists():
        if folder.exists():
            shutil.rmtree(_old(folder))
        else:
            _old(folder).rename(folder)
    _clear_parts(folder)


@contextmanager
def locked_folder_beside(folder: Path) -> Iterator[Path]:
    """Temporary folder beside `folder`; a killed process's goes with the next `clear_leftovers`."""
    from filelock import lock_descriptor

    # The lock ends with the process, however it ends; a process number could be another's by then.
    fresh = _fresh_name(folder)
    fresh.mkdir()
    handle = os.open(fresh, os.O_RDONLY)
    try:
        lock_descriptor(handle)
        yield fresh
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
        os.close(handle)


def _fresh_name(place: Path) -> Path:
    return place.with_name(f".{place.name}.{secrets.token_hex(4)}.part")


def _clear_parts(place: Path) -> None:
    """What was begun for `place` by a process that lives no more goes; all else is left alone."""
    ours = re.compile(rf"\.{re.escape(place.name)}\.[0-9a-f]{{8}}\.part")
    for leftover in place.parent.iterdir():
        if ours.fullmatch(leftover.name) and not leftover.is_symlink():
            _remove_unless_locked(leftover)


def _remove_unless_locked(leftover: Path) -> None:
    from filelock import lock_descriptor

    try:
        handle = os.open(leftover, os.O_RDONLY)
    except FileNotFoundError:  # another process was faster
        return
    try:
        if not lock_descriptor(handle, blocking=False):
            return
        if leftover.is_dir():
            shutil.rmtree(leftover)
        else:
            leftover.unlink(missing_ok=True)
    finally:
        os.close(handle)


def _replace(folder: Path, fresh: Path) -> None:
    # POSIX cannot exchange folders; killed between the two renames, the next run undoes the first.
    # Another process may publish the same dive meanwhile: then its result is the older one.
    while True:
        try:
            fresh.rename(folder)
            break
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
        shutil.rmtree(_old(folder), ignore_errors=True)
        with suppress(FileNotFoundError):
            folder.rename(_old(folder))
    _sync(folder.parent)
    shutil.rmtree(_old(folder), ignore_errors=True)


def _flush(folder: Path) -> None:
    """To the disk side by side: one after the other, each file would wait for it anew."""
    inside = [path for path in folder.rglob("*") if not path.is_symlink()]
    with ThreadPoolExecutor(_FLUSHED_AT_ONCE) as threads:
        list(threads.map(_sync, inside))
    _sync(folder)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _old(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.old")
