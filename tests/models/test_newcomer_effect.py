"""One file of an effect in its folder: catalogue, handbook, export, simulation and shared tests know it."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from exported_files import make, predict
from verbs import run_verb

import pipeline.models.effects
from pipeline.models import catalogue, find_effect
from pipeline.sources import find_preset

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs" / "tools"))
FILE = '''"""Side pull: the vehicle is pushed to the left, more than in proportion to its speed.

k [s/m] is the sideways speed at 1 m/s. Drive forward and backward at several speeds.

Source: a newcomer's first effect.
"""

from pipeline.models.families import Excitation, Parameter, declare

SidePull = declare(
    "side_pull",
    __doc__,
    "v_y += k * v0 * abs(v0)",
    Parameter("k", "s/m", (-1.0, 1.0), 0.0, "sideways speed at 1 m/s", 0.1),
    needs=(Excitation.SPEED_SPREAD,),
    confused_with=("lateral_drift",),
)
'''
TESTS = ("effects", "export")
PLUGIN = """
import pipeline.models.effects
pipeline.models.effects.__path__.append({folder!r})
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of effects with one more file."""
    place = tmp_path / "more_effects"
    place.mkdir()
    (place / "side_pull.py").write_text(FILE, encoding="utf-8")
    paths = [*pipeline.models.effects.__path__, str(place)]
    monkeypatch.setattr(pipeline.models.effects, "__path__", paths)
    catalogue.list_effects.cache_clear()
    yield place
    catalogue.list_effects.cache_clear()
    sys.modules.pop("pipeline.models.effects.side_pull", None)


@pytest.mark.usefixtures("folder")
def test_a_file_of_an_effect_is_all_that_it_needs(tmp_path: Path) -> None:
    assert len(FILE.splitlines()) < 25
    page = run_verb("effects", "side_pull").stdout
    assert "\n    v_y += k * v0 * abs(v0)\n" in page
    assert "Source: a newcomer's first effect." in page
    from effects_pages import write_effect_pages  # noqa: PLC0415 - a tool of the handbook

    handbook = write_effect_pages()
    assert "    v_y += k * v0 * abs(v0)\n" in handbook["effects/side_pull.md"]
    assert "[side_pull](side_pull.md)" in handbook["effects/index.md"]
    vehicle = find_preset("husky_a200")
    effect = find_effect("side_pull")(k=0.2)
    assert effect.describe_motion(vehicle) == "Side pull: k = 0.2 s/m"
    rows = predict(make(effect), [(-1.0, 5.0, 5.0)], 0.005)
    speed = 5.0 * vehicle.wheel_radius_m
    np.testing.assert_allclose(rows[0, 4:6], (speed, 0.2 * speed**2))
    log = tmp_path / "run.mcap"
    made = run_verb("simulate", "--effect", "side_pull=0.1", "--duration", "60", "--file", str(log))
    assert made.returncode == 0, made.stderr
    model = tmp_path / "model.toml"
    assert run_verb("model", "new", str(model), "--vehicle", "husky_a200").returncode == 0
    added = run_verb("model", "add", str(model), "side_pull", "--on", str(log), "--anyway", cwd=tmp_path)
    assert added.returncode == 0, added.stderr
    assert find_value(model) == pytest.approx(0.1, rel=0.1)


def find_value(model: Path) -> float:
    from pipeline.models import read_model  # noqa: PLC0415 - after the file was written

    return read_model(model).model.effect("side_pull").values["k"]


def test_the_shared_tests_run_over_it(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "one_more_effect.py").write_text(PLUGIN.format(folder=str(folder)), encoding="utf-8")
    tests = [f"tests/models/test_motion_{name}.py" for name in TESTS]
    words = [
        "-p",
        "one_more_effect",
        "-p",
        "no:cacheprovider",
        "-n",
        "0",
        "-q",
        "-k",
        "side_pull or sentence",
    ]
    told = subprocess.run(
        [sys.executable, "-m", "pytest", *words, *tests, "tests/models/test_effect_sentences.py"],
        cwd=ROOT,
        env={"PYTHONPATH": str(tmp_path), "PATH": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    assert told.returncode == 0, told.stdout
    assert told.stdout.startswith("." * 7), told.stdout
