"""The doors of rooms: what they list is there, and nothing else is."""

import inspect
from importlib import import_module
from pathlib import Path

import pytest

import pipeline

ROOMS = [
    path.parent.name
    for path in sorted(Path(pipeline.__file__).parent.glob("*/__init__.py"))
    if "open_door" in path.read_text(encoding="utf-8")
]


@pytest.mark.parametrize("room", ROOMS)
def test_every_name_of_a_door_is_in_its_file(room: str) -> None:
    door = import_module(f"pipeline.{room}")
    listed = inspect.getclosurevars(door.__getattr__).nonlocals["file_of"]
    assert listed
    for name, file in listed.items():
        assert getattr(door, name) is getattr(import_module(f"pipeline.{room}.{file}"), name)
    with pytest.raises(AttributeError, match="has no attribute 'no_such_name'"):
        door.no_such_name  # noqa: B018 - asking is the test
