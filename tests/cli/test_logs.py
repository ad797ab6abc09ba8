"""A log that nobody reads holds nobody up."""

from __future__ import annotations

import logging
import os
import threading

import pytest

from ortholoc_edge.cli.logs import from_a_thread_of_its_own


@pytest.fixture
def pipe():
    """A logger whose handler writes to a pipe that nobody reads yet."""
    reader, writer = os.pipe()
    stream = os.fdopen(writer, "w", buffering=1)
    logger = logging.Logger("test")
    logger.addHandler(logging.StreamHandler(stream))
    yield logger, reader
    stream.close()


def read_on(reader: int, text: list[bytes]) -> threading.Thread:
    def read() -> None:
        while data := os.read(reader, 65536):
            text.append(data)

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    return thread


def test_who_logs_into_a_full_pipe_does_not_wait(pipe):
    logger, reader = pipe
    done = threading.Event()

    def log() -> None:
        for n in range(5000):
            logger.warning("line %d %s", n, "x" * 100)
        done.set()

    text: list[bytes] = []
    with from_a_thread_of_its_own(logger):
        # More than the pipe (64 KiB) and the queue hold. Without the queue this thread never ends.
        threading.Thread(target=log, daemon=True).start()
        went_on = done.wait(20.0)
        read_on(reader, text)
        assert went_on
        logger.warning("and after that")
    written = b"".join(text).decode()
    assert "line 0 " in written


def test_what_was_lost_is_counted_and_order_is_kept(pipe):
    logger, reader = pipe
    text: list[bytes] = []
    with from_a_thread_of_its_own(logger):
        handler = logger.handlers[0]
        handler.queue.maxsize = 10
        for n in range(5000):
            logger.warning("line %d %s", n, "x" * 100)
        assert handler.dropped > 0
        read_on(reader, text)
        while not handler.queue.empty():
            threading.Event().wait(0.01)
        logger.warning("last")
    for _ in range(500):
        if b"last" in b"".join(text):
            break
        threading.Event().wait(0.01)
    lines = b"".join(text).decode().splitlines()
    written = [int(line.split()[1]) for line in lines if line.startswith("line")]
    lost = [int(line.split()[0]) for line in lines if "log lines were lost" in line]
    assert written == sorted(set(written))
    assert len(written) + sum(lost) == 5000 and lines[-1] == "last"


def test_it_ends_though_nobody_reads(pipe):
    logger, reader = pipe
    before, threads = list(logger.handlers), set(threading.enumerate())
    with from_a_thread_of_its_own(logger):
        for n in range(3000):
            logger.warning("line %d %s", n, "x" * 100)
    assert logger.handlers == before
    writers = set(threading.enumerate()) - threads
    read_on(reader, [])
    for writer in writers:
        writer.join(10.0)
