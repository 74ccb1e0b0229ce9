"""The fixture of the store's tests."""

from collections.abc import Iterator

import pytest
import seaweed


@pytest.fixture(scope="session")
def s3_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[seaweed.S3Server]:
    with seaweed.running(tmp_path_factory.mktemp("seaweedfs")) as server:
        yield server
