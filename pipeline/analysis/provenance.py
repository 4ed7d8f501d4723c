"""What computed the numbers of a run: this program, Python, and the packages that took part."""

import platform
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version

from pipeline.analysis.log_setup import LogSetup
from pipeline.analysis.work import Work
from pipeline.core.version import PACKAGE, read_version
from pipeline.logs import ROS1_BAG, SQLITE_BAG
from pipeline.stages.extract import list_wanted

_Packages = Mapping[str, tuple[str, ...]]
_ALWAYS = ("numpy", "scipy", "polars", "pyarrow")
_CONTAINER: _Packages = {"": ("mcap",), ROS1_BAG: ("rosbags", "lz4"), SQLITE_BAG: ("rosbags", "apsw")}
_COMPRESSION: _Packages = {"zstd": ("zstandard",), "lz4": ("pyarrow",)}
_ENCODING: _Packages = {"protobuf": ("mcap", "mcap-protobuf-support")}


def list_versions(work: Work) -> dict[str, str]:
    """Versions of the packages that read this log and computed its numbers.

    Args:
        work: after its stages and its diagnosis.
    """
    names = {*_ALWAYS, *_list_readers(work.setup)}
    versions = {name: _look_up(name) for name in sorted(names)}
    return {"python": platform.python_version(), PACKAGE: read_version(), **versions}


def _list_readers(setup: LogSetup) -> set[str]:
    """Packages that inflate or decode what a run takes from its log."""
    index = setup.index
    wanted = {one.topic for one in list_wanted(setup.sources, index.types)}
    encodings = {channel.message_encoding for channel in index.channels if channel.topic in wanted}
    used = [_CONTAINER.get(name, ()) for name in index.containers]
    used += [_COMPRESSION.get(name, ()) for name in index.compressions]
    used += [_ENCODING.get(name, ()) for name in encodings]
    return {name for names in used for name in names}


@cache
def _look_up(name: str) -> str:
    return version(name)
