"""Runs a server of the emulators beside a test."""

from __future__ import annotations

import asyncio
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

from tests.support.waiting import WAIT_S


@contextmanager
def simulated(make_head):
    """Yield an executor of one thread and the head that it has made; close it in the end."""
    with ThreadPoolExecutor(1) as simulation:
        head = simulation.submit(make_head).result()
        try:
            yield simulation, head
        finally:
            simulation.submit(head.close).result()


@contextmanager
def running(server):
    """Run a server in an event loop of another thread while the block lasts; an error of it is raised in the end."""
    loop, began, failures = asyncio.new_event_loop(), threading.Event(), []

    async def serve():
        started = asyncio.Event()
        task = asyncio.create_task(server.run(started.set))
        waiting = asyncio.create_task(started.wait())
        await asyncio.wait({task, waiting}, return_when=asyncio.FIRST_COMPLETED)
        waiting.cancel()
        began.task = task
        began.set()
        try:
            await task
        except asyncio.CancelledError:
            pass
        except Exception as why:
            failures.append(why)

    thread = threading.Thread(target=lambda: loop.run_until_complete(serve()))
    thread.start()
    assert began.wait(WAIT_S)
    try:
        yield server
    finally:
        loop.call_soon_threadsafe(began.task.cancel)
        thread.join(WAIT_S)
        loop.close()
    assert not failures, failures
