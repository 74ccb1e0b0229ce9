"""A sample of odd command lines in odd surroundings; LIGHTKILN_HOSTILE_COMMANDS says how many."""

import os
import random
import signal
import tempfile
from collections import Counter
from collections.abc import Iterator
from http.server import ThreadingHTTPServer
from pathlib import Path

import pytest
from hostile_commands import Impostor, attempts, furnish, run

EXAMPLES = int(os.environ.get("LIGHTKILN_HOSTILE_COMMANDS", "96"))
RENDERERS = ("shade", "reference", "compare")
"""Their libraries take seconds to load in each process."""


@pytest.fixture
def impostor() -> Iterator[str]:
    """The URL of somebody who is no coordinator, in a process of its own: the one that forks has no threads."""
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        with ThreadingHTTPServer(("127.0.0.1", 0), Impostor) as server:
            os.write(writing, f"{server.server_port}\n".encode())
            server.serve_forever()
    port = int(os.read(reading, 16))
    yield f"http://127.0.0.1:{port}"
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    os.close(reading)
    os.close(writing)


def test_every_command_ends_with_a_sentence_and_a_documented_code(impostor: str) -> None:
    chosen = [attempt for attempt in attempts(impostor) if attempt.arguments[0] not in RENDERERS]
    random.Random(7).shuffle(chosen)
    with tempfile.TemporaryDirectory(prefix="lightkiln-commands-") as name:
        folder = Path(name) / "work"
        furnish(folder)
        Path(name).chmod(0o755)
        ended = [run(attempt, folder) for attempt in chosen[:EXAMPLES]]
    failed = [(one.attempt, one.problems, one.said[-500:]) for one in ended if one.problems]
    codes = Counter(one.code for one in ended)
    print(f"{len(ended)} of {len(chosen)} command lines; exit codes {dict(sorted(codes.items()))}")
    assert len(ended) == min(EXAMPLES, len(chosen)) and not failed
