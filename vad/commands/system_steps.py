"""Steps that change this machine: files written, files taken away, programs run; each said, or only said."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

from vad.commands.service_files import MARK
from vad.errors import VadError

Say = Callable[[str, str], None]
"""Takes what was (or would be) done in a word or two, and to what."""


class Steps:
    """Does steps and says them. dry: only say them. say: hears of each."""

    def __init__(self, say: Say, *, dry: bool) -> None:
        self._say = say
        self._dry = dry

    def write(self, path: Path, text: str, mode: int = 0o644) -> bool:
        """Have a file with this text; whether that changed anything. What somebody else wrote there stays.

        Raises VadError where it cannot be written.
        """
        try:
            before = path.read_text(encoding="utf-8") if path.exists() else None
            if before == text:
                self._say("is there", str(path))
                return False
            if before is not None and not _is_ours(before):
                self._say("left as it is (not written by vad install)", str(path))
                return False
            if not self._dry:
                path.parent.mkdir(parents=True, exist_ok=True)
                fresh = path.with_name(f".{path.name}.new")
                fresh.write_text(text, encoding="utf-8")
                fresh.chmod(mode)
                fresh.replace(path)
        except OSError as error:
            raise VadError(f"cannot be written ({error.strerror})", where=str(path)) from error
        self._say("changed" if before is not None else "wrote", str(path))
        return True

    def remove(self, path: Path) -> bool:
        """Take away a file that `write` has made; whether it was there. Somebody's own stays."""
        if not path.is_file():
            return False
        if not _is_ours(path.read_text(encoding="utf-8")):
            self._say("left as it is (not written by vad install)", str(path))
            return False
        self._say("removed", str(path))
        if not self._dry:
            path.unlink()
        return True

    def remove_tree(self, path: Path) -> None:
        """Take away a folder, or a link, with all that is in it."""
        if path.is_symlink():
            self._say("removed", str(path))
            if not self._dry:
                path.unlink()
        elif path.exists():
            self._say("removed", f"{path} with all that was in it")
            if not self._dry:
                shutil.rmtree(path)

    def link(self, path: Path, target: Path) -> None:
        """Have a symbolic link, where nothing of that name is."""
        if path.is_symlink() or path.exists():
            return
        self._say("linked", f"{path} -> {target}")
        if not self._dry:
            path.symlink_to(target)

    def run(self, *command: str, may_fail: bool = False) -> None:
        """Run a program of the system. Raises VadError with what it said where it fails."""
        self._say("ran", " ".join(command))
        if self._dry:
            return
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        except OSError as error:
            if may_fail:
                return
            raise VadError(f"cannot be run ({error.strerror})", where=command[0]) from error
        if done.returncode and not may_fail:
            said = (done.stderr or done.stdout).strip()
            raise VadError(said or f"ended with {done.returncode}", where=" ".join(command))


def answer_of(command: Sequence[str]) -> str:
    """What a program of the system says; empty where it cannot be run."""
    try:
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    except OSError:
        return ""


def _is_ours(text: str) -> bool:
    return text.startswith(MARK.partition(";")[0])
