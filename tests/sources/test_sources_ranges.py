"""Every number that a user writes has a range: a value is used, or refused in one line that names it."""

import math
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import msgspec
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from verbs import run_slip

from pipeline.core import SlipError
from pipeline.datasets.check import Limits, read_limits
from pipeline.models.model_file import read_model
from pipeline.plan.plan_files import StoredPlan, read_plan
from pipeline.sources import VehicleSection, load_configuration
from pipeline.sources.configuration import Configuration, explain_range, list_bounds

LOG = Path(__file__).parents[2] / "data_samples" / "husky_tile.mcap"
SIZES = (0.0, 5e-324, 1e-300, 1e-15, 0.5, 1e3, 1e15, 2.0**63, 1e300, math.inf)
NUMBERS = st.sampled_from([*SIZES, *(-size for size in SIZES), math.nan, 2**62, -(2**63), 2**63, 10**400])
Number = tuple[tuple[str, ...], tuple[float, float]]


def list_numbers(kind: msgspec.inspect.Type, keys: tuple[str, ...] = ()) -> Iterator[Number]:
    """Keys and range of each number below a type; `[]` stands for an entry of a list."""
    for one in kind.types if isinstance(kind, msgspec.inspect.UnionType) else (kind,):
        if (bounds := list_bounds(one)) is not None:
            yield keys, bounds
        if isinstance(one, msgspec.inspect.StructType):
            for field in one.fields:
                yield from list_numbers(field.type, (*keys, field.encode_name))
        elif isinstance(one, msgspec.inspect.ListType):
            yield from list_numbers(one.item_type, (*keys, "[]"))
        elif isinstance(one, msgspec.inspect.DictType):
            names = getattr(one.key_type, "values", ["left"])
            yield from list_numbers(one.value_type, (*keys, str(max(names))))


CONFIGURED = list(list_numbers(msgspec.inspect.type_info(Configuration)))
LIMITED = list(list_numbers(msgspec.inspect.type_info(Limits)))
PLANNED = list(list_numbers(msgspec.inspect.type_info(StoredPlan)))
VEHICLES = list(list_numbers(msgspec.inspect.type_info(VehicleSection)))


def format_toml(keys: tuple[str, ...], number: float) -> str:
    """A file that sets one number."""
    value = f"{keys[-1]} = {number}" if keys[-1] != "[]" else str(number)
    for key, below in reversed(list(pairwise(keys))):
        value = f"[{{{value}}}]" if key == "[]" else f"{key} = {value if below == '[]' else f'{{{value}}}'}"
    return f"{value}\n"


def judge(error: SlipError, keys: tuple[str, ...], path: Path, what: str = "") -> None:
    """The line names file and key, says what is wrong, and is one line."""
    assert what in error.what
    assert str(path) in error.where
    assert keys[-1] in error.what
    assert "\n" not in str(error)
    assert len(str(error)) < 1000


def use_or_refuse(
    read: Callable[[], object], path: Path, which: Number, number: float, what: str = ""
) -> None:
    """Read a file with a number: within its range it is used, else refused in one line."""
    keys, (least, largest) = which
    try:
        read()
    except SlipError as error:
        judge(error, keys, path, what)
    else:
        assert least <= number <= largest


def test_every_number_has_a_finite_range() -> None:
    for keys, bounds in [*CONFIGURED, *LIMITED, *PLANNED, *VEHICLES]:
        assert -1e300 < bounds[0] < bounds[1] < 1e300, keys


def test_the_numbers_are_found() -> None:
    found = {".".join(keys) for keys, _ in CONFIGURED}
    assert {
        "velocity.rate_hz",
        "wheels.factors.left",
        "interval.[].start_s",
        "wheels.ignore.[].end_s",
    } < found
    assert {"error.position.min", "slip.left.change"} < {".".join(keys) for keys, _ in LIMITED}


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(CONFIGURED), NUMBERS)
def test_a_number_of_a_configuration_is_used_or_refused(tmp_path: Path, which: Number, number: float) -> None:
    keys, (least, largest) = which
    path = tmp_path / "run.toml"
    path.write_text(format_toml(keys, number))
    finite = isinstance(number, float) and math.isfinite(number)
    what = f"{number:g} is outside its range, {least:g} to {largest:g}" if finite else ""
    use_or_refuse(lambda: load_configuration(tmp_path / "run.mcap"), path, which, number, what)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(LIMITED), NUMBERS)
def test_a_number_of_limits_is_used_or_refused(tmp_path: Path, which: Number, number: float) -> None:
    keys, _ = which
    path = tmp_path / "limits.toml"
    path.write_text(format_toml(keys, number))
    use_or_refuse(lambda: read_limits(path), path, which, number)


PROMISE = {
    "question": '"drive_lag.tau"',
    "effects": '["drive_lag"]',
    "kind": '"interval"',
    "goal": 1,
    "expected": 1,
}


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(PLANNED), NUMBERS)
def test_a_number_of_a_plan_is_used_or_refused(tmp_path: Path, which: Number, number: float) -> None:
    keys, _ = which
    path = tmp_path / "plan.toml"
    lines = [f"{key} = {value}" for key, value in (PROMISE | {keys[-1]: number}).items()]
    path.write_text("\n".join(['vehicle = "husky"', "[[promises]]", *lines]))
    use_or_refuse(lambda: read_plan(path), path, which, number)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(VEHICLES), NUMBERS)
def test_a_number_of_a_models_vehicle_is_used_or_refused(
    tmp_path: Path, which: Number, number: float
) -> None:
    keys, _ = which
    path = tmp_path / "model.toml"
    path.write_text(f'[vehicle]\npreset = "husky_a200"\n{format_toml(keys, number)}')
    use_or_refuse(lambda: read_model(path), path, which, number)


PARAMETER = ["value", "low", "high", "bounds", "neutral"]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.dictionaries(st.sampled_from(PARAMETER), NUMBERS, min_size=1))
@example({"value": 1e300})
@example({"low": -1e300, "high": 1e300})
def test_a_number_of_a_models_effect_is_used_or_refused(tmp_path: Path, numbers: dict[str, float]) -> None:
    path = tmp_path / "model.toml"
    texts = [f"{key} = {[number, 2.0] if key == 'bounds' else number}" for key, number in numbers.items()]
    for text in ('id = "drive_lag"\ntau = ', 'id = "mine"\nv_y = "k * v0"\nk = '):
        path.write_text(f'[vehicle]\npreset = "husky_a200"\n[[effect]]\n{text}{{{", ".join(texts)}}}\n')
        with pytest.MonkeyPatch.context() as context:
            context.chdir(tmp_path)
            code, _, err = run_slip("model", "show", str(path))
        assert code in {0, 1}
        assert code == 0 or (err.count("\n") == 1 and "model.toml" in err)


ATTACKS = {
    "command.late_s": "[command]\nlate_s = 1e300\n",
    "late_s": "[wheels]\nlate_s = -1e15\n",
    "command.scale": "[command]\nscale = 1e300\n",
    "velocity.rate_hz": "[velocity]\nrate_hz = 1e-300\n",
    "wheels.per_turn": '[wheels]\nunit = "ticks"\nper_turn = 5e-324\n',
}


@pytest.mark.parametrize("key", ATTACKS)
def test_a_number_that_broke_a_stage_is_one_line_with_its_range(key: str, tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text(ATTACKS[key])
    code, _, err = run_slip("analyze", str(LOG), "--config", str(path), "--results", str(tmp_path / "r"))
    assert code == 1
    assert f"{path}, line" in err
    assert f"{key} = " in err
    assert "is outside its range" in err
    assert err.count("\n") == 1


@pytest.mark.long
@pytest.mark.parametrize(("keys", "bounds"), CONFIGURED, ids=str)
def test_the_ends_of_a_range_can_be_analyzed(
    keys: tuple[str, ...], bounds: tuple[float, float], tmp_path: Path
) -> None:
    path = tmp_path / "own.toml"
    for number in {*bounds, *([0.0] if bounds[0] < 0.0 < bounds[1] else [])}:
        path.write_text(format_toml(keys, number))
        code, _, err = run_slip(
            *("analyze", str(LOG), "--no-report", "--no-diagnosis", "--force"),
            *("--config", str(path), "--results", str(tmp_path / "r")),
        )
        assert code in {0, 1, 3}, (number, err)


def test_a_length_in_another_unit_is_told_in_each_that_fits() -> None:
    _, hint = explain_range("wheel_radius_m", 165.0, (1e-3, 2.5))
    assert hint == "If it is in centimetres, write 1.65; if it is in millimetres, write 0.165."
