"""Hostile messages on everything that reads the bus: `tools/fuzz_bus.py`, a little of it and a lot."""

from __future__ import annotations

import subprocess
import sys

import pytest
from bus_world import ROOT

pytestmark = pytest.mark.timeout(600)
"""Much work for the processor: a busy machine takes many times as long as an idle one."""


def fuzz(*arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "tools/fuzz_bus.py", *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        errors="replace",
        check=False,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


def test_a_little_noise_is_refused_and_counted() -> None:
    said = fuzz("150", "1", "--live", "100")
    assert said.count("client: ") >= 8
    assert "bad_input" in said
    assert "refused" in said


@pytest.mark.slow
def test_a_lot_of_noise_breaks_nothing_and_fills_nothing() -> None:
    fuzz("5000", "2", "--live", "5000")
