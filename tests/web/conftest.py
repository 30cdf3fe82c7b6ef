"""A page that runs, for every test that wants one."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from waiting import until
from web_world import Serving, World, world


@pytest.fixture
def serving(tmp_path: Path) -> Serving:
    """`async with serving(...) as world`: the page answers until the block ends."""

    @asynccontextmanager
    async def serve(**options: Any) -> AsyncIterator[World]:
        async with world(tmp_path, **options) as made:
            task = asyncio.create_task(made.page.run())
            try:
                await until(lambda: made.page.health.state == "ok", "the page listens")
                yield made
            finally:
                task.cancel()
                await asyncio.wait({task}, timeout=40)
                assert task.cancelled(), "the page ends when it is told to"

    return serve
