"""kill -9 at random moments, on a disk that has room and on one that is full: nothing that was said is lost.

`tools/bench kill --kills 200` is the long form.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))

import bench_kill
from bench_kill import torture


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine takes its time to load a program: one that has not said anything yet is not mute."""
    monkeypatch.setattr(bench_kill, "MUTE_S", 120.0)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 8 MB; skipped where none may be mounted."""
    folder = tmp_path / "small"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", folder], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip("no file system may be mounted here")
    yield folder
    subprocess.run(["umount", folder], check=True)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_nothing_said_is_lost_to_kills(tmp_path: Path) -> None:
    tally = torture(tmp_path, kills=25, seed=1, fill=False)
    assert tally.said >= 25, "each life said something"
    assert tally.missing == []
    assert tally.set_aside == 0


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_nothing_said_is_lost_to_kills_on_a_full_disk(small_disk: Path) -> None:
    tally = torture(small_disk, kills=12, seed=2, fill=True)
    assert tally.said >= 8, "each life with room said something"
    assert tally.missing == []
    assert tally.set_aside == 0
