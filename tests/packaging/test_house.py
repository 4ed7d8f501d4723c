from pathlib import Path

import pytest
from house import find_room, list_constants, list_faults, read_sources

pytestmark = pytest.mark.lint


def write_files(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        path = root / "pipeline" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, "utf-8")


def find_faults(root: Path, files: dict[str, str]) -> list[str]:
    write_files(root, files)
    return list(list_faults(read_sources(root)))


@pytest.mark.parametrize(
    "back",
    [
        "from pipeline.a.first import go\n",
        "from pipeline.a import first\n",
        "import pipeline.a.first\n",
        "from .first import go\n",
        "from . import first\n",
        "def late():\n    from pipeline.a.first import go\n",
        "class Late:\n    from .first import go\n",
        "if True:\n    from pipeline.a import first\n",
        "if TYPE_CHECKING:\n    pass\nelse:\n    from pipeline.a import first\n",
    ],
)
def test_a_circle_of_imports_is_refused_wherever_the_import_stands(tmp_path: Path, back: str) -> None:
    files = {"a/first.py": "from pipeline.a.second import go\n", "a/second.py": back, "a/__init__.py": ""}
    (fault,) = find_faults(tmp_path, files)
    assert fault.startswith("import circle: ")
    assert "pipeline.a.first" in fault
    assert "pipeline.a.second" in fault


def test_a_circle_by_way_of_a_package_is_refused(tmp_path: Path) -> None:
    files = {
        "a/__init__.py": "from pipeline.a.first import go\n",
        "a/first.py": "from pipeline.a import go\n",
    }
    assert find_faults(tmp_path, files) == ["import circle: pipeline.a -> pipeline.a.first -> pipeline.a"]


def test_what_only_the_type_checker_imports_is_no_circle(tmp_path: Path) -> None:
    back = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from pipeline.first import go\n"
    assert find_faults(tmp_path, {"first.py": "from pipeline.second import go\n", "second.py": back}) == []


def test_numbers_are_counted_by_name(tmp_path: Path) -> None:
    write_files(tmp_path, {"stages/near.py": "_NEAR, _FAR = 0.5, 2.0\n_NAME = 'near'\n"})
    (source,) = read_sources(tmp_path)
    assert find_room(source) == "stages"
    assert [constant.name for constant in list_constants(source)] == ["_NEAR", "_FAR"]
