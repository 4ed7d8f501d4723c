"""Python files that came with somebody's logs are not imported, whatever their names, whatever verb runs."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Sequence
from pathlib import Path

import pytest

from pipeline.simulate import simulate_case

OTHERS = ("pipeline", "numpy", "polars", "pyarrow", "pebble", "cyclopts", "usercustomize", "sitecustomize")
SLIP = Path(sysconfig.get_path("scripts")) / "slip"
MARK = "open({mark!r}, 'a').write(__file__ + '\\n')\n"


@pytest.fixture(scope="module")
def trap(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a log, and a file by the name of every module there could be beside it."""
    folder = tmp_path_factory.mktemp("logs")
    simulate_case("husky_tile", out=folder / "run.mcap", duration_s=20.0)
    text = MARK.format(mark=str(folder / "imported"))
    for name in {*sys.stdlib_module_names, *OTHERS}:
        (folder / f"{name}.py").write_text(text, encoding="utf-8")
    return folder


def run_in(folder: Path, command: Sequence[str | Path], *, codes: Sequence[int] = (0,)) -> str:
    """What a command prints that is started in the folder as a user would, by its path."""
    (folder / "imported").unlink(missing_ok=True)
    safe = {"PYTHONSAFEPATH", "PYTHONPATH"}
    environment = {key: value for key, value in os.environ.items() if key not in safe}
    environment["XDG_CACHE_HOME"] = str(folder / "cache")
    done = subprocess.run(
        command,
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        stdin=subprocess.DEVNULL,
    )
    assert done.returncode in codes, done.stderr
    assert not (folder / "imported").exists(), (folder / "imported").read_text(encoding="utf-8")
    return done.stdout


def test_the_trap_works(trap: Path) -> None:
    with pytest.raises(AssertionError, match="tempfile"):
        run_in(trap, [sys.executable, "-c", "import tempfile"])


def test_processes_that_libraries_start_do_not_look_there(trap: Path) -> None:
    program = """import sys
sys.path.pop(0)
import multiprocessing
from pipeline.core import keep_current_folder_out
keep_current_folder_out()
process = multiprocessing.get_context("spawn").Process(target=print)
process.start()
process.join()
sys.exit(process.exitcode)
"""
    run_in(trap, [sys.executable, "-c", program])


def test_the_module_looks_there_for_nothing_of_its_own(trap: Path, tmp_path: Path) -> None:
    """Python itself looks there for what ``-m`` needs to begin; what comes then is slip's to choose."""
    for name in ("tempfile", "numpy", "polars", "cyclopts"):
        shutil.copy(trap / f"{name}.py", tmp_path)
    shutil.copy(trap / "run.mcap", tmp_path)
    run_in(tmp_path, [sys.executable, "-m", "pipeline", "inspect", "run.mcap"])
    assert not (trap / "imported").exists()


def test_the_script_does_not_look_there(trap: Path) -> None:
    run_in(trap, [SLIP, "inspect", "run.mcap"])


@pytest.mark.long
def test_no_verb_imports_from_the_current_folder(trap: Path) -> None:
    run_in(trap, [SLIP, "analyze", "run.mcap", "--results", "results", "--no-diagnosis"])
    assert list((trap / "cache").rglob("vega-*.js"))
    run_in(trap, [SLIP, "batch", "run.mcap", "--results", "many", "--jobs", "2", "--settle", "0"])


@pytest.mark.long
def test_the_workbench_s_diagnosis_does_not_look_there(trap: Path) -> None:
    run_in(trap, [SLIP, "analyze", "run.mcap", "--results", "results", "--no-diagnosis", "--no-report"])
    program = """import sys
sys.path.pop(0)
import json
from pathlib import Path
from pipeline.store import Store
from pipeline.web.jobs import DIAGNOSE, work
from pipeline.analysis import Options
from pipeline.batch.batch_work import Task
from pipeline.store import see_log
results = Path("results")
(name,) = Store(results).runs()
options = Options(out=results, run=name)
entry = work(Task(path=results, log=see_log(Path("run.mcap")), fingerprint=DIAGNOSE, options=options)).entry
print(json.dumps([entry.run, entry.reason]))
"""
    said = run_in(trap, [sys.executable, "-c", program])
    assert json.loads(said)[1] == ""
