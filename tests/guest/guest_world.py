"""The guest of tools/guest, as the tests call it."""

from __future__ import annotations

import subprocess
from collections.abc import Callable

Guest = Callable[..., subprocess.CompletedProcess[str]]
"""`guest(folder, *qemu_options, timeout_s=600)`: run folder/run.sh in a guest; how that ended."""
