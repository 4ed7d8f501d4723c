"""Facts that stand in TOML files of this folder."""

import tomllib
from importlib import resources
from typing import Any


def read_facts(name: str) -> dict[str, Any]:
    """The tables of one of the files."""
    return tomllib.loads(resources.files("pipeline.simulate").joinpath(name).read_text("utf-8"))
