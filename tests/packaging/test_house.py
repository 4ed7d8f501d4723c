from pathlib import Path

import pytest
from house import (
    BESIDE,
    MOST_LINES,
    find_room,
    list_constants,
    list_faults,
    list_long_files,
    measure_headers,
    read_sources,
)

ROOT = Path(__file__).parents[2]


def write_files(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        path = root / "pipeline" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, "utf-8")


def find_faults(root: Path, files: dict[str, str]) -> list[str]:
    """Faults of files beside one that has no header."""
    write_files(root, {"plain.py": "x = 1\n" * MOST_LINES, **files})
    return list(list_faults(read_sources(root)))


def test_files_import_each_other_without_circles_under_names_of_their_own() -> None:
    assert list(list_faults(read_sources(ROOT))) == []


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


def test_two_files_of_one_name_are_refused_but_for_packages(tmp_path: Path) -> None:
    files = {"a/twin.py": "", "b/twin.py": "", "a/__init__.py": "", "b/__init__.py": ""}
    assert find_faults(tmp_path, files) == ["two files of one name: pipeline/a/twin.py, pipeline/b/twin.py"]


def test_a_file_that_is_too_long_is_refused(tmp_path: Path) -> None:
    files = {"long.py": "x = 1\n" * (MOST_LINES + 1), "short.py": "x = 1\n" * MOST_LINES}
    assert find_faults(tmp_path, files) == ["pipeline/long.py has 501 lines, more than 500"]


def test_no_test_or_tool_of_this_project_is_too_long() -> None:
    assert list(list_long_files(read_sources(ROOT, BESIDE))) == []


def test_headers_are_docstrings_and_imports(tmp_path: Path) -> None:
    text = '"""Two\nlines."""\n\nimport ast\n\nif TYPE_CHECKING:\n    import enum\n\nx = 1\ny = 2\n'
    write_files(tmp_path, {"one.py": text})
    assert measure_headers(read_sources(tmp_path)) == pytest.approx(0.5)


@pytest.mark.parametrize(("imports", "faults"), [(7, []), (8, ["8.00% of all lines are headers"])])
def test_more_headers_than_seven_percent_are_refused(tmp_path: Path, imports: int, faults: list[str]) -> None:
    write_files(tmp_path, {"one.py": "import ast\n" * imports + "x = 1\n" * (100 - imports)})
    assert [fault.partition(",")[0] for fault in list_faults(read_sources(tmp_path))] == faults


@pytest.mark.parametrize(
    "text",
    [
        "_NEAR = 0.5\n",
        "_NEAR: Final = 0.5\n",
        "_NEAR, _FAR = 0.5, 2.0\n",
        "_NEAR = (0.5, 2.0)\n",
        "_NEAR = 2 * _FAR\n",
        "_NEAR = -0.5\n\n_WORDS = ()\n",
        "# What follows is of poses.\n\n_NEAR = 0.5\n",
        "_FAR = 2.0  # [m]\n_NEAR = 0.5\n",
    ],
)
def test_a_number_that_decides_answers_is_refused_without_a_reason(tmp_path: Path, text: str) -> None:
    faults = find_faults(tmp_path, {"stages/near.py": text})
    assert any(": _NEAR has no reason" in fault for fault in faults)
    assert all(fault.startswith("pipeline/stages/near.py:") for fault in faults)


@pytest.mark.parametrize(
    "text",
    [
        '_NEAR = 0.5\n"""Distance [m]: poses wander by less."""\n',
        "_NEAR = 0.5  # [m]: poses wander by less\n",
        "# Distance [m]: poses wander by less.\n_NEAR = 0.5\n",
        '_NEAR, _FAR = 0.5, 2.0\n"""Distances [m]: poses wander by less."""\n',
        "_NAME = 'near'\n",
        "_IS_NEAR = True\n",
        "_HALF_NEAR = near / far\n",
        "near = 0.5\n",
        "def go():\n    NEAR = 0.5\n",
    ],
)
def test_a_reason_stands_below_beside_or_above_a_number(tmp_path: Path, text: str) -> None:
    assert find_faults(tmp_path, {"stages/near.py": text}) == []


def test_numbers_of_other_rooms_need_no_reason(tmp_path: Path) -> None:
    assert find_faults(tmp_path, {"cli/near.py": "_NEAR = 0.5\n", "far.py": "_NEAR = 0.5\n"}) == []


def test_numbers_are_counted_by_name(tmp_path: Path) -> None:
    write_files(tmp_path, {"stages/near.py": "_NEAR, _FAR = 0.5, 2.0\n_NAME = 'near'\n"})
    (source,) = read_sources(tmp_path)
    assert find_room(source) == "stages"
    assert [constant.name for constant in list_constants(source)] == ["_NEAR", "_FAR"]
