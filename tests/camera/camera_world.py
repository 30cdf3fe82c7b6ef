"""A camera that runs beside a test."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from waiting import until

from vad.camera.frame import CameraSource, FrameQueue


@asynccontextmanager
async def running(camera: CameraSource, depth: int = 500) -> AsyncIterator[FrameQueue]:
    """Its frames; at the end it is cancelled, and has left no thread."""
    out = FrameQueue(depth)
    before = set(threading.enumerate())
    task = asyncio.create_task(camera.run(out))
    try:
        yield out
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

        def left() -> set[str]:
            names = {thread.name for thread in threading.enumerate() if thread not in before}
            return {name for name in names if not name.startswith("asyncio_")}

        # A camera waits for its thread for a moment only; on a busy machine that ends a little later.
        await until(lambda: not left(), f"the camera's threads end: {left()}")
