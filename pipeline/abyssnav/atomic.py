# SPDX-License-Identifier: Apache-2.0
"""Output folders that appear whole or not at all, whatever ends the process."""

import errno
import fcntl
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from abyssnav.errors import PipelineError

#: By this file a folder is known as a result of ours; it is written last.
SEAL = "summary.json"


@contextmanager
def appearing(folder: Path) -> Iterator[Path]:
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
        if folder.exists() and not (folder / SEAL).is_file():
            raise PipelineError(f"{folder}: exists and is no result of abyssnav; not replaced")
        with locked_folder_beside(folder) as fresh:
            yield fresh
            _flush(fresh)
            _replace(folder, fresh)
    except OSError as error:
        place = error.filename or folder
        raise PipelineError(f"{place}: cannot be written: {error.strerror or error}") from None


@contextmanager
def appearing_file(path: Path) -> Iterator[Path]:
    """File to write that takes the place of `path` when all went well.

    Raises
    ------
    PipelineError
        `path` cannot be written.
    """
    fresh = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield fresh
        _sync(fresh)
        fresh.replace(path)
        _sync(path.parent)
    except OSError as error:
        raise PipelineError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        fresh.unlink(missing_ok=True)


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
    for leftover in folder.parent.iterdir():
        if leftover.name.startswith(f".{folder.name}.") and leftover.suffix == ".part":
            _remove_unless_locked(leftover)


@contextmanager
def locked_folder_beside(folder: Path) -> Iterator[Path]:
    """Temporary folder beside `folder`; a killed process's goes with the next `clear_leftovers`."""
    # The lock ends with the process, however it ends; a process number could be another's by then.
    fresh = folder.with_name(f".{folder.name}.{secrets.token_hex(4)}.part")
    fresh.mkdir()
    handle = os.open(fresh, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield fresh
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
        os.close(handle)


def _remove_unless_locked(leftover: Path) -> None:
    handle = os.open(leftover, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return
    else:
        shutil.rmtree(leftover)
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
    for path in (*folder.rglob("*"), folder):
        _sync(path)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _old(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.old")
