"""In the files of all targets names from logs and model files are data, and absurd numbers are refused."""

import math
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from exported_files import CAR, FIT, HUSKY, make
from exported_texts import HOSTILE, READERS
from few import few
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import structs
from verbs import run_verb

from pipeline.core import SlipError
from pipeline.export import export_model, list_targets, read_current
from pipeline.models import Model, ModelFile, find_effect, format_model
from pipeline.models.formula import FormulaEffect, make_parameter
from pipeline.models.model_file import parse_model
from pipeline.run import MotionError
from pipeline.sources.configuration import RANGES

HARMLESS = "Yard robot 7"
NAMES = st.one_of(
    st.sampled_from(HOSTILE),
    st.text(max_size=30),
    st.text(alphabet="-'\"\\\n\r{}<>!#: \x00\u2028aNx", max_size=12),
)
VEHICLES = {"differential": HUSKY, "ackermann": CAR}


def make_named(kind: str, name: str) -> ModelFile:
    """A model that has the name wherever a log or a model file can put one."""
    effects = [
        find_effect("drive_lag")(tau=0.2),
        find_effect("wheel_radius")(k=0.97),
        find_effect("body_speed_limit")(limit=0.9),
    ]
    if kind == "ackermann":
        effects.append(find_effect("steering_offset")(o=0.02))
    wind = FormulaEffect("a---é", {"v_y": "k * v0"}, (make_parameter("k", "1", (-1.0, 1.0)),), k=0.1)
    fit = {
        **FIT,
        "input": name,
        "runs": [{"run": name, "terrain": name, "driven_speed_mps": 1.5, "driven_yaw_rate_radps": 1.0}],
        "undecided": [["drive_lag", name]],
        name or "empty": name,
    }
    known = {"wheel_radius.k": (0.96, 0.98), "a---é.k": (0.0, 0.2), "body_speed_limit.limit": (0.8, 1.0)}
    vehicle = structs.replace(VEHICLES[kind], name=name, id=name)
    return make(*effects, wind, vehicle=vehicle, fit=fit, intervals=known, note=name)


GAINS = {
    "speed_to_erpm_gain": 4614.0,
    "steering_angle_to_servo_gain": -1.2135,
    "steering_angle_to_servo_offset": 0.5304,
}
KINDS = {"autoware": {"ackermann"}, "vesc": {"ackermann"}}
TARGETS = [
    (target.name, kind)
    for target in list_targets()
    for kind in KINDS.get(target.name, ("differential", "ackermann"))
]


def test_a_number_of_several_grounds_names_each() -> None:
    own = {"snow": 2.5, "tile": 1.9}
    fit = {
        **FIT,
        "runs": [{"run": f"day/{name}", "terrain": name} for name in own],
        "own": [
            {"run": f"day/{name}", "parameter": "effective_track.k", "value": k} for name, k in own.items()
        ],
    }
    text = export_model(make(find_effect("effective_track")(k=2.2), fit=fit), "ros2_control")
    assert "# effective_track.k = 2.2, the mean of 1.9 on 'tile', 2.5 on 'snow'" in text


@pytest.mark.parametrize(("target", "kind"), few(TARGETS, 4))
@settings(max_examples=8)
@given(name=NAMES)
def test_a_name_is_data_in_the_files_of_all_targets(target: str, kind: str, name: str) -> None:
    check_names(target, kind, [name])


@pytest.mark.parametrize(("target", "kind"), TARGETS)
def test_names_that_were_made_to_break_out_are_data(target: str, kind: str) -> None:
    check_names(target, kind, HOSTILE)


def check_names(target: str, kind: str, names: Sequence[str]) -> None:
    plain, known = READERS[target](export_model(make_named(kind, HARMLESS), target, GAINS))
    assert HARMLESS in known
    for name in names:
        shape, found = READERS[target](export_model(make_named(kind, name), target, GAINS))
        assert shape == plain
        assert [HARMLESS if one == name else one for one in found] == known


# What is valid Unicode, which all that logs and model files hold is, and not empty.
TEXTS = NAMES.filter(lambda name: bool(name) and not any("\ud800" <= one <= "\udfff" for one in name))


@given(name=TEXTS)
@settings(max_examples=60)
def test_a_name_comes_back_from_a_model_file(name: str) -> None:
    text = format_model(make_named("differential", name))
    assert tomllib.loads(text)["vehicle"]["name"] == name
    again = parse_model(text, Path("m.toml"))
    assert (again.model.vehicle.name, again.note) == (name, name)
    assert format_model(again) == text
    assert READERS["python"](export_model(again, "python"))[1] == [name]


ABSURD = (math.nan, math.inf, -math.inf, 1e300, -1e300)


def list_absurd(kind: str) -> list[ModelFile]:
    """The model with one number that no robot has, in every place that has one."""
    file = make_named(kind, HARMLESS)
    vehicle = file.model.vehicle
    files = [
        replace(file, model=Model(structs.replace(vehicle, **{key: value}), file.model.effects))
        for key in RANGES
        for value in (*ABSURD, *((-1.0, 0.0, 1e-300) if key != "base_to_rear_axle_m" else ()))
    ]
    wide = (make_parameter("k", "1", (-math.inf, math.inf)),)
    wild = [FormulaEffect("wild", {"v_y": "k * v0"}, wide, k=value) for value in (1e300, -1e300)]
    files += [replace(file, model=file.model + effect) for effect in wild]
    (run,) = file.list_fitted("runs")
    files += [
        replace(file, fit={**file.fit, "runs": [{**run, key: value}]})
        for key in ("driven_speed_mps", "driven_yaw_rate_radps")
        for value in (*ABSURD, -1.0)
    ]
    return files


@pytest.mark.parametrize(("target", "kind"), few(TARGETS, 4))
def test_absurd_numbers_are_refused_in_one_line(target: str, kind: str) -> None:
    for file in list_absurd(kind):
        with pytest.raises(SlipError) as caught:
            export_model(file, target, GAINS)
        assert caught.value.code in {"absurd_number", "implausible_geometry"}
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [*ABSURD, -0.1])
def test_absurd_errors_are_refused_before_a_covariance_is_made(value: float) -> None:
    file = make_named("differential", HARMLESS)
    ladder = [{"effects": [], "velocity_rms": [0.3, value, 0.4]}]
    with pytest.raises(MotionError, match="velocity_rms"):
        export_model(replace(file, fit={**file.fit, "ladder": ladder}), "robot_localization")


@pytest.mark.parametrize("text", ["nan", "inf", "-inf", "1e300"])
def test_absurd_numbers_of_the_robots_own_file_are_refused(tmp_path: Path, text: str) -> None:
    yaml_text = text.replace("inf", ".inf").replace("nan", ".nan").replace("1e300", "1.0e+300")
    files = {"px4": f"1\t1\tRO_MAX_THR_SPEED\t{text}\t9\n", "vesc": f"speed_to_erpm_gain: {yaml_text}\n"}
    for target, content in files.items():
        path = tmp_path / target
        path.write_text(content, encoding="utf-8")
        with pytest.raises(MotionError, match="not a plausible number"):
            export_model(make(vehicle=CAR), target, GAINS | read_current(path, target))


def test_nothing_is_written_of_an_absurd_model(tmp_path: Path) -> None:
    model, out = tmp_path / "m.toml", tmp_path / "out.yaml"
    text = '[vehicle]\npreset = "husky_a200"\nmass_kg = 1e300\n'
    for content in (text, text.replace("1e300", "inf"), text.replace("1e300", "-5")):
        model.write_text(content, encoding="utf-8")
        said = run_verb("model", "export", model, "--to", "nav2", "--file", out)
        assert said.returncode != 0
        assert len(said.stderr.splitlines()) == 1
        assert "mass_kg" in said.stderr
        assert not out.exists()


@pytest.mark.parametrize(
    "text",
    [
        "a: 1" + "0" * 400,
        "a: 1" + "0" * 5000,
        "a: !!timestamp x",
        "a: !!int ''",
        "a: 2026-99-99",
        "l0: &l0 {x: 1}\n" + "".join(f"l{n}: &l{n} {{x: *l{n - 1}, y: *l{n - 1}}}\n" for n in range(1, 40)),
        "",
    ],
)
def test_a_robots_own_file_is_read_whatever_else_stands_in_it(tmp_path: Path, text: str) -> None:
    path = tmp_path / "vesc.yaml"
    path.write_text(f"speed_to_erpm_gain: 5000.0\n{text}\n", encoding="utf-8")
    found = read_current(path, "vesc")
    assert found["speed_to_erpm_gain"] == 5000.0
    assert export_model(make(vehicle=CAR), "vesc", GAINS | found)
