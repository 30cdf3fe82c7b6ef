"""Private files: written whole or not at all, readable by their owner alone."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from fcntl import LOCK_EX, LOCK_UN, flock
from pathlib import Path

from vad.errors import VadError

FILE_MODE = 0o600
FOLDER_MODE = 0o700


def make_folder(folder: Path) -> None:
    """An empty folder for its owner alone; VadError where something is in it already.

    Made by root inside somebody's folder (the daemon's state, say), it and its files become that owner's.
    """
    try:
        folder.mkdir(mode=FOLDER_MODE, parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise VadError("the folder is not empty", where=str(folder), remedy="Name a new one")
        folder.chmod(FOLDER_MODE)
        _give_to_owner_of(folder.parent, folder)
    except OSError as error:
        raise _unusable(folder, error) from error


def write_private(path: Path, content: bytes) -> None:
    """Replace `path` in one step; a reader, or a power cut, meets the old content or the new."""
    fresh = path.with_name(f".{path.name}.new")
    try:
        with suppress(FileNotFoundError):
            fresh.unlink()
        descriptor = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, FILE_MODE)
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        _give_to_owner_of(path.parent, fresh)
        fresh.replace(path)
        _sync(path.parent)
    except OSError as error:
        raise _unusable(path, error) from error


def read_private(path: Path) -> bytes:
    """The content of a file that only its owner may read; VadError where others may, too."""
    try:
        content = path.read_bytes()
        mode = stat.S_IMODE(path.stat().st_mode)
    except OSError as error:
        raise _unusable(path, error) from error
    if mode & 0o077:
        raise VadError(
            f"others may read this private file (mode {mode:o})",
            where=str(path),
            remedy=f"chmod 600 {path}; if somebody may have read it, issue it anew",
        )
    return content


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Alone in `folder`: the daemon renews there while a command issues."""
    path = folder / ".lock"
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, FILE_MODE)
    except OSError as error:
        raise _unusable(path, error) from error
    try:
        _give_to_owner_of(folder, path)
        flock(descriptor, LOCK_EX)
        yield
    finally:
        flock(descriptor, LOCK_UN)
        os.close(descriptor)


def _give_to_owner_of(folder: Path, path: Path) -> None:
    """What root makes in the daemon's folder must be the daemon's, or it could not read it."""
    if os.geteuid() == 0:
        owner = folder.stat()
        os.chown(path, owner.st_uid, owner.st_gid)


def _sync(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _unusable(path: Path, error: OSError) -> VadError:
    remedy = "Run it as the folder's owner, or with sudo" if isinstance(error, PermissionError) else ""
    return VadError(f"cannot be used ({error.strerror})", where=str(path), remedy=remedy)
