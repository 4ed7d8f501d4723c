import math
from pathlib import Path

import pytest
from motion_runs import vehicle_of

from pipeline.models import (
    Model,
    ModelFile,
    Number,
    format_model,
    list_effects,
    load_effects,
    parse_model,
    read_model,
    write_model,
)
from pipeline.run import MotionError
from pipeline.sources import list_configuration_files, load_configuration

HEAD = '[vehicle]\npreset = "husky_a200"\n\n'
HERE = Path("model.toml")

OWN_EFFECT = '''
"""Tilt: an effect of a user's own."""
from pipeline.models import LinearEffect, Parameter


class Tilt(LinearEffect):
    """Adds speed to the left."""

    id = "tilt"
    parameters = (Parameter("k", "1", (-1.0, 1.0), 0.0, "share", 0.1),)

    def columns(self, rolling, velocity, around):
        return {"k": (0.0, rolling.v0, 0.0)}
'''


def test_every_effect_survives_a_round_trip() -> None:
    for kind, preset in (("differential", "husky_a200"), ("ackermann", "ackermann_car")):
        effects = [
            effect(**{p.name: p.typical for p in effect.parameters})
            for effect in list_effects()
            if kind in effect.kinds
        ]
        effects[0] = effects[0].fix(*effects[0].values)
        model = Model(vehicle_of(preset), tuple(effects))
        label = f"{effects[1].id}.{effects[1].parameters[0].name}"
        file = ModelFile(
            model,
            per_run=(label,),
            numbers={label: Number(math.nan, 0.25, 0.75)},
            note='a "note"\nwith lines',
        )
        again = parse_model(format_model(file), HERE)
        assert again == file
        assert format_model(again) == format_model(file)


def test_what_was_fitted_stands_in_the_file(tmp_path: Path) -> None:
    fit = {
        "input": "measured",
        "runs": [{"run": "a/b", "sha256": "ab" * 32}],
        "ladder": [{"effects": [], "velocity_rms": [0.1, 0.2, 0.3]}],
    }
    path = tmp_path / "m.toml"
    write_model(ModelFile(Model(vehicle_of("warthog")), fit=fit), path)
    assert read_model(path).fit == fit
    assert [item.name for item in tmp_path.iterdir()] == ["m.toml"]


@pytest.mark.parametrize("name", ["may.toml", "run.toml", "fleet.toml"])
def test_a_model_does_not_replace_a_log_s_configuration(name: str, tmp_path: Path) -> None:
    path, model = tmp_path / name, ModelFile(Model(vehicle_of("warthog")))
    path.write_text('[run]\nterrain = "ice"\n', encoding="utf-8")
    write_model(model, tmp_path / "model.toml")
    write_model(model, path)
    path.write_text('[run]\nterrain = "ice"\n', encoding="utf-8")
    (tmp_path / "may.mcap").touch()
    with pytest.raises(MotionError, match=r"it is the configuration of may\.mcap") as caught:
        write_model(model, path)
    assert caught.value.code == "model_misplaced"
    assert path.read_text(encoding="utf-8") == '[run]\nterrain = "ice"\n'


@pytest.mark.parametrize("name", ["may.toml", "run.toml"])
def test_a_model_beside_a_log_is_not_its_configuration(name: str, tmp_path: Path) -> None:
    log, path = tmp_path / "may.mcap", tmp_path / name
    log.touch()
    for _ in range(2):
        write_model(ModelFile(Model(vehicle_of("warthog"))), path)
        assert path not in list_configuration_files(log)
    path.write_text('# format = 1\n[run]\nterrain = "ice"\n', encoding="utf-8")
    assert load_configuration(log).run.terrain == "ice"


def test_formulas_are_read_and_written() -> None:
    text = HEAD + '[[effect]]\nid = "wind"\nv_y = "k * sin(yaw)"\nk = { unit = "m/s", bounds = [-1, 1] }\n'
    file = parse_model(text, HERE)
    wind = file.model.effect("wind")
    assert wind.parameter("k").bounds == (-1.0, 1.0)
    assert parse_model(format_model(file), HERE).model.effect("wind") == wind


def test_effects_of_one_s_own_are_known_once_their_file_was_loaded(tmp_path: Path) -> None:
    (tmp_path / "my_effects.py").write_text(OWN_EFFECT, encoding="utf-8")
    text = HEAD + '[[effect]]\nid = "tilt"\nk = 0.2\n'
    with pytest.raises(MotionError, match=r"model.toml:5: no effect is called 'tilt'.*--effects FILE.py"):
        parse_model(text, HERE)
    load_effects([tmp_path / "my_effects.py"])
    file = parse_model(text, HERE)
    assert file.model.effect("tilt").values == {"k": 0.2}
    assert parse_model(format_model(file), HERE).model.ids == ("tilt",)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("1 / 0", "ZeroDivisionError"),
        ("x = 1", "it defines no effect"),
        (OWN_EFFECT.replace('"tilt"', '"drive_lag"'), "of the catalogue is called 'drive_lag'"),
    ],
)
def test_a_file_of_effects_that_does_not_work_is_named(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "own.py"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(MotionError, match=says) as caught:
        load_effects([path])
    assert caught.value.where == str(path)
