"""What all tests share: the recordings, the Debian package; that no test leaks a task or a thread."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import subprocess
import threading
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest
import pytest_asyncio
from hypothesis import HealthCheck, settings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as vad.cli does, before NumPy is imported

# A shell has what it starts in the background ignore Ctrl-C, and what that starts in turn: tests send it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

os.environ["COLUMNS"] = "160"  # tables look alike in a terminal, in a pipe and in a parallel run

# How long an example takes, or its making, says how busy the machine is, not whether the code is right.
# In CI every run tries the same examples; elsewhere each run looks for new ones.
settings.register_profile(
    "vad",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize="CI" in os.environ,
)
settings.load_profile("vad")

ROOT = Path(__file__).resolve().parents[1]
SHARED_DATA = ROOT.parent / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of recordings beside the checkout; the test is skipped where it is absent."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"no recordings at {SHARED_DATA}")
    return SHARED_DATA


@pytest.fixture(scope="session")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Debian package of this checkout; VAD_DEB names one that is built already."""
    if given := os.environ.get("VAD_DEB"):
        return Path(given)
    if shutil.which("dpkg-deb") is None:
        pytest.skip("no dpkg-deb: apt-get install dpkg")
    folder = tmp_path_factory.mktemp("package")
    build = [str(ROOT / "tools" / "deb" / "build"), "--out", str(folder)]
    done = subprocess.run(build, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return Path(done.stdout.split()[-1])


@pytest.fixture(autouse=True)
def no_leaked_threads() -> Iterator[None]:
    """Fail a test that leaves a thread of its own behind."""
    before = set(threading.enumerate())
    yield
    leaked = [
        t
        for t in threading.enumerate()
        if t not in before and not t.daemon and not t.name.startswith("asyncio_")
    ]
    for thread in leaked:
        thread.join(timeout=20.0)  # one that ends by itself is none, however busy the machine
    still = [t.name for t in leaked if t.is_alive()]
    assert not still, f"threads left behind: {still}"


@pytest_asyncio.fixture(autouse=True)
async def no_leaked_tasks() -> AsyncIterator[None]:
    """Fail a test that leaves an asyncio task running."""
    yield
    current = asyncio.current_task()
    leaked = [t for t in asyncio.all_tasks() if t is not current and not t.done()]
    assert not leaked, f"tasks left behind: {leaked}"
