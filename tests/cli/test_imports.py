"""What a verb imports: starting the program costs whoever asks for little no more than that."""

import subprocess
import sys
from pathlib import Path

import pytest

TABLES = {"polars", "pyarrow", "dataframely"}
ALWAYS = {"altair", "starlette", "mcap_protobuf"}
"""What neither help nor reading, the stages or the report has a use for."""

CODE = """
import sys
from pipeline.cli import main
try:
    main(sys.argv[1:])
except SystemExit as end:
    assert end.code == 0, end.code
print("\\nimported:", *sys.modules)
"""


def list_imports(*words: str | Path) -> set[str]:
    """All modules that a run of the program has imported when it ends."""
    command = [sys.executable, "-c", CODE, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return set(done.stdout.rpartition("imported: ")[2].split())


@pytest.mark.parametrize("words", [["--help"], ["diagnose", "--help"], ["--version"]], ids=" ".join)
def test_help_imports_nothing_that_computes(words: list[str]) -> None:
    assert not list_imports(*words) & (
        TABLES | ALWAYS | {"numpy", "scipy", "numba", "jinja2", "msgspec", "mcap"}
    )


def test_a_verb_imports_no_other_verb() -> None:
    verbs = {name for name in list_imports("analyze", "--help") if name.startswith("pipeline.cli.verb")}
    assert verbs == {"pipeline.cli.verbs_log"}


def test_inspect_imports_neither_contracts_nor_what_stores(samples: Path) -> None:
    unwanted = {"pyarrow", "dataframely", "jinja2", "filelock"} | ALWAYS
    assert not list_imports("inspect", samples / "husky_tile.mcap") & unwanted


def test_slip_tables_are_made_without_a_compiler_and_effects(samples: Path, tmp_path: Path) -> None:
    words = ("--results", tmp_path, "--no-diagnosis", "--no-report", "--quiet")
    unwanted = {"numba", "scipy.optimize", "scipy.spatial", "pipeline.models.catalogue"}
    assert not list_imports("analyze", samples / "husky_tile.mcap", *words) & unwanted


def test_stages_and_report_import_no_library_of_charts(samples: Path, tmp_path: Path) -> None:
    words = ("--results", tmp_path, "--no-diagnosis", "--quiet")
    imported = list_imports("analyze", samples / "husky_tile.mcap", *words)
    assert (next(tmp_path.glob("runs/*/*/latest")) / "report.html").is_file()
    assert "pipeline.report.page" in imported
    assert not imported & ALWAYS


def test_one_log_imports_nothing_of_bags_and_servers_to_be_diagnosed(samples: Path, tmp_path: Path) -> None:
    imported = list_imports("diagnose", samples / "husky_tile.mcap", "--results", tmp_path, "--quiet")
    assert not imported & ALWAYS
