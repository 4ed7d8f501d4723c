"""A local S3 server that stands in for an object store."""

from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest
from moto.server import ThreadedMotoServer

BUCKET = "s3://field"


@pytest.fixture(scope="session")
def server() -> Iterator[str]:
    place = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    place.start()
    host, port = place.get_host_and_port()
    yield f"http://{host}:{port}"
    place.stop()


@pytest.fixture
def bucket(server: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[fsspec.AbstractFileSystem]:
    """An empty bucket; whoever uses `s3://` in this test, or in a process it starts, gets to it."""
    for name, value in {
        "AWS_ENDPOINT_URL": server,
        "AWS_ACCESS_KEY_ID": "a",
        "AWS_SECRET_ACCESS_KEY": "b",
        "AWS_DEFAULT_REGION": "us-east-1",
    }.items():
        monkeypatch.setenv(name, value)
    fsspec.get_filesystem_class("s3").clear_instance_cache()
    store = fsspec.filesystem("s3", listings_expiry_time=60)
    store.mkdir(BUCKET)
    yield store
    store.rm(BUCKET, recursive=True)
    fsspec.get_filesystem_class("s3").clear_instance_cache()


def upload(store: fsspec.AbstractFileSystem, files: dict[str, Path | bytes]) -> None:
    for key, content in files.items():
        store.pipe_file(f"{BUCKET}/{key}", content if isinstance(content, bytes) else content.read_bytes())
    store.invalidate_cache()
