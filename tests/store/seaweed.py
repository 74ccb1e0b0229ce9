"""A SeaweedFS server of the tests' own: a real S3 endpoint with one bucket and one key."""

import contextlib
import json
import random
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

KEY, SECRET, BUCKET = "test-key", "test-secret", "kiln-test"
GRPC_OFFSET = 10_000  # where SeaweedFS puts the gRPC port of a service


@dataclass(frozen=True)
class S3Server:
    endpoint: str
    bucket: str = BUCKET

    def environment(self) -> dict[str, str]:
        """What a client needs in its environment."""
        return {
            "AWS_ACCESS_KEY_ID": KEY,
            "AWS_SECRET_ACCESS_KEY": SECRET,
            "AWS_REGION": "us-east-1",
            "AWS_ENDPOINT_URL": self.endpoint,
            "AWS_EC2_METADATA_DISABLED": "true",
        }


@contextlib.contextmanager
def running(folder: Path) -> Iterator[S3Server]:
    """The server, its data in `folder`, until the end of the block."""
    identity = {
        "name": "test",
        "credentials": [{"accessKey": KEY, "secretKey": SECRET}],
        "actions": ["Admin", "Read", "Write", "List", "Tagging"],
    }
    (folder / "s3.json").write_text(json.dumps({"identities": [identity]}))
    names = ("master.port", "volume.port", "filer.port", "s3.port", "admin.port")
    ports = dict(zip(names, free_ports(len(names)), strict=True))
    settings: dict[str, object] = ports | {
        "dir": folder,
        "ip": "127.0.0.1",
        "ip.bind": "127.0.0.1",
        "s3.config": folder / "s3.json",
        "s3.port.iceberg": 0,
        "s3.port.lance": 0,
        "bucket": BUCKET,
        "webdav": "false",
        "admin.ui": "false",
        "master.telemetry": "false",
    }
    weed = str(Path(sys.executable).with_name("weed"))
    command = [weed, "mini", *(f"-{name}={value}" for name, value in settings.items())]
    with (folder / "log").open("wb") as log, subprocess.Popen(command, stdout=log, stderr=log, cwd=folder) as server:
        try:
            wait_until_ready(server, folder / "log")
            yield S3Server(f"http://127.0.0.1:{ports['s3.port']}")
        finally:
            server.kill()


def free_ports(count: int) -> list[int]:
    """Ports that are free, and GRPC_OFFSET above them too."""
    ports: list[int] = []
    while len(ports) < count:
        port = random.randrange(20_000, 20_000 + GRPC_OFFSET)  # so that none is the gRPC port of another
        if port in ports:
            continue
        with socket.socket() as low, socket.socket() as high:
            try:
                low.bind(("127.0.0.1", port))
                high.bind(("127.0.0.1", port + GRPC_OFFSET))
            except OSError:
                continue
        ports.append(port)
    return ports


def wait_until_ready(server: "subprocess.Popen[bytes]", log: Path) -> None:
    deadline = time.monotonic() + 600.0
    while time.monotonic() < deadline and server.poll() is None:
        if b"components are running and ready" in log.read_bytes():
            return
        time.sleep(0.1)
    raise RuntimeError(f"SeaweedFS does not start: {log.read_text()[-2000:]}")
