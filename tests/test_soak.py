"""A short form of tools/bench soak: four days with everything that the daemon holds, and nothing grows."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_four_days_lose_nothing_and_leave_nothing_open() -> None:
    command = [
        sys.executable,
        "tools/bench_soak.py",
        "--days",
        "4",
        "--walks",
        "1",
        "--devices",
        "3",
        "--json",
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=1790)
    assert done.stdout, done.stderr
    month = json.loads(done.stdout)
    nights = month["nights"]
    assert len(nights) == 4
    assert month["lost"] == []
    assert month["walks"] >= 3
    assert nights[-1]["solved"] >= 3
    assert nights[-1]["devices"] == 3 + 4, "the household's, and a guest's each evening"
    assert nights[-1]["asked"] > 3 * nights[-1]["devices"]
    for name in ("tasks", "descriptors"):
        counts = {night[name] for night in nights[1:]}
        assert max(counts) - min(counts) <= 4, f"{name}: {counts}"
    # The first days fill caches and start threads: growth is judged from then on.
    assert nights[-1]["rss_mb"] < 1.05 * nights[-2]["rss_mb"]
