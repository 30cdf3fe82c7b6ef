"""The Debian guest of tools/guest, for the tests that need a kernel or a systemd of their own."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest
from guest_world import Guest

RUN = Path(__file__).resolve().parents[2] / "tools" / "guest" / "run"
NEEDED = ("qemu-system-x86_64", "mmdebstrap", "mksquashfs", "busybox", "modprobe", "cpio", "zstd", "dpkg-deb")
PACKAGES = "qemu-system-x86 mmdebstrap squashfs-tools busybox-static kmod cpio zstd"


@pytest.fixture(scope="session")
def guest() -> Guest:
    """The guest; skipped where it cannot be built."""
    if missing := [tool for tool in NEEDED if shutil.which(tool) is None]:
        pytest.skip(f"no {', '.join(missing)}: apt-get install {PACKAGES}")
    if os.geteuid() != 0:
        pytest.skip("building the guest needs root")

    def run(folder: Path, *options: str, timeout_s: int = 600) -> subprocess.CompletedProcess[str]:
        limit = {**os.environ, "VAD_GUEST_TIMEOUT_S": str(timeout_s)}
        command = [str(RUN), str(folder), *options]
        return subprocess.run(command, env=limit, capture_output=True, text=True, check=False)

    return run
