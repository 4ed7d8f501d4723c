"""The core without its extras: slip tables as ever, and one clear line for what needs one."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml
from comparison_store import Run, write_run
from few import few

from pipeline.core import SlipError, require_package
from pipeline.simulate import simulate_case
from pipeline.store import Store

ROOT = Path(__file__).parents[2]
EXTRAS = ("distributed", "pandas", "s3fs", "starlette", "uvicorn")
DRAWN_OR_COMPILED = ("llvmlite", "numba", "vl_convert")
"""Packages that come without an extra, and that a machine may lack nevertheless."""
LEAN = f"""
import sys

class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {(*EXTRAS, *DRAWN_OR_COMPILED)!r}:
            raise ModuleNotFoundError(f"no module named {{name}}", name=name)

sys.meta_path.insert(0, Hidden())
for name in {(*EXTRAS, *DRAWN_OR_COMPILED)!r}:
    sys.modules[name] = None
from pipeline.cli import main
main(sys.argv[1:])
"""
"""The program where none of these packages is installed."""


def run_lean(*words: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", LEAN, *map(str, words)]
    around = {**os.environ, "XDG_CACHE_HOME": str(cwd / "cache")}
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=cwd, env=around)


def test_slip_tables_need_no_extra(tmp_path: Path) -> None:
    simulate_case("husky_tile", out=tmp_path / "logs" / "a.mcap", duration_s=20.0)
    done = run_lean("analyze", "logs/a.mcap", "--no-diagnosis", "--no-report", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "median slip modulus" in done.stdout
    again = run_lean(
        "batch", "logs", "--settle", 0, "--executor", "inline", "--results", "other", cwd=tmp_path
    )
    assert again.returncode == 0, again.stderr

    whole = [sys.executable, "-m", "pipeline", "analyze", "logs/a.mcap", "--no-diagnosis", "--no-report"]
    subprocess.run([*whole, "--results", "whole"], check=True, capture_output=True, cwd=tmp_path)
    tables = [
        next((tmp_path / name / "runs").glob("*/*/*/slip.parquet")).read_bytes()
        for name in ("results", "whole")
    ]
    assert tables[0] == tables[1]


@pytest.mark.long
def test_datasets_are_compared_without_what_draws_pages(tmp_path: Path) -> None:
    for number, terrain in enumerate(("ice", "gravel")):
        run = Run(name=f"field/{terrain}", dataset=f"warthog_{terrain}", terrain=terrain)
        write_run(Store(tmp_path / "results"), run, seed=number)
    done = run_lean("compare", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "slip of warthog, from commands" in done.stdout
    assert done.stdout.endswith("page    none: pip install slip-pipeline draws it\n")
    assert (tmp_path / "results" / "comparisons.csv").is_file()
    refused = run_lean("compare", "--figures", "svg", cwd=tmp_path)
    assert refused.returncode == 1
    assert "pip install slip-pipeline" in refused.stderr


@pytest.mark.parametrize(
    ("words", "lines"),
    few(
        [
            (
                ("analyze", "a.mcap", "--figures", "svg"),
                ("a report needs vl_convert, which is not installed. Install it: pip install slip-pipeline",),
            ),
            (("diagnose", "a.mcap"), ("needs numba, which is not installed.", "pip install slip-pipeline.")),
            (
                ("batch", ".", "--executor", "inline", "--settle", "0"),
                ("pip install slip-pipeline, or leave it out with --no-diagnosis",),
            ),
            (
                ("serve",),
                (
                    "the workbench needs uvicorn, which is not installed.",
                    "pip install 'slip-pipeline[serve]'.",
                ),
            ),
        ],
        4,
    ),
)
def test_what_needs_an_extra_says_so_in_one_line(
    words: tuple[str, ...], lines: tuple[str, ...], tmp_path: Path
) -> None:
    simulate_case("husky_tile", out=tmp_path / "a.mcap", duration_s=10.0)
    refused = run_lean(*words, cwd=tmp_path)
    assert refused.returncode == 1
    assert [line for line in lines if line not in refused.stderr] == []
    assert "Traceback" not in refused.stderr


def test_analyze_says_in_one_line_what_it_leaves_out(tmp_path: Path) -> None:
    simulate_case("husky_tile", out=tmp_path / "a.mcap", duration_s=10.0)
    done = run_lean("analyze", "a.mcap", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (line,) = [one for one in done.stderr.splitlines() if one.startswith("slip: ")]
    assert line == (
        "slip: left out, not installed: the effects (Numba) and the report (vl-convert); "
        "to have it: pip install slip-pipeline"
    )
    assert "median slip modulus" in done.stdout
    plain = run_lean("analyze", "a.mcap", "--no-diagnosis", "--no-report", cwd=tmp_path)
    assert "left out" not in plain.stderr


def test_what_is_there_is_not_refused() -> None:
    require_package("numpy", "diagnose", "this")
    with pytest.raises(SlipError, match="this needs no_such_package"):
        require_package("no_such_package", "diagnose", "this")


@pytest.mark.lint
def test_the_extras_of_the_handbook_are_those_of_the_wheel() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    (whole,) = extras["all"]
    named = set(re.findall(r"\w+", whole.partition("[")[2]))
    assert named == set(extras) - {"all", "build", "dev", "docs"}
    page = (ROOT / "docs" / "pages" / "install.md").read_text()
    assert {extra for extra in named if f"`[{extra}]`" in page} == named


@pytest.mark.lint
def test_the_recipe_of_conda_needs_what_the_wheel_needs() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    recipe = yaml.safe_load((ROOT / "packaging" / "conda.yaml").read_text())
    extras = project["optional-dependencies"]
    wanted = [*project["dependencies"], *extras["serve"]]
    wanted = [one.replace(">=", " >=") for one in wanted if not one.startswith("slip-pipeline")]
    assert sorted(recipe["requirements"]["run"]) == sorted([*wanted, f"python {project['requires-python']}"])
    assert recipe["context"]["version"] == project["version"]
    name, _, target = recipe["build"]["python"]["entry_points"][0].partition(" = ")
    assert project["scripts"] == {name: target}
    assert (ROOT / "packaging" / recipe["source"]["path"] / recipe["about"]["license_file"]).is_file()
