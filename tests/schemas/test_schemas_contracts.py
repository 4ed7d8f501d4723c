"""Contracts: every column says what it is, stored files say it too, and bad rows are told from good ones."""

from pathlib import Path

import dataframely as dy
import polars as pl
import pyarrow.parquet as pq
import pytest

from pipeline.store import Store
from schemas import Contract, contract_of, list_contracts

CONTRACTS = list_contracts()


def test_every_column_says_what_it_is() -> None:
    for contract in CONTRACTS:
        columns = contract.schema.columns()
        assert [name for name in columns if not contract.metadata_of(name).get("description")] == []


def test_every_real_number_has_a_unit() -> None:
    for contract in CONTRACTS:
        columns = contract.schema.columns()
        real = [name for name, column in columns.items() if isinstance(column, dy.Float64)]
        assert [name for name in real if not contract.metadata_of(name).get("unit")] == []


def test_a_table_is_a_plural_noun_with_a_version_and_knows_its_run() -> None:
    for contract in CONTRACTS:
        assert contract.version >= 1
        assert contract.name == contract.schema.__name__.lower()
        assert {"run", "dataset", "vehicle", "terrain"} <= set(contract.schema.columns())


def test_velocities_and_slip_stand_in_the_body_frame() -> None:
    for table, names in (("velocities", ("v_x", "v_y", "v_w")), ("slip", ("f_x", "v_y", "g_w", "modulus"))):
        assert {contract_of(table).metadata_of(name)["frame"] for name in names} == {"base_link"}


def test_no_table_of_that_name_lists_those_there_are() -> None:
    with pytest.raises(KeyError, match="velocities"):
        contract_of("velocity")


@pytest.mark.parametrize("contract", CONTRACTS, ids=lambda contract: contract.name)
def test_stored_columns_carry_unit_frame_and_description(contract: Contract, tmp_path: Path) -> None:
    store = Store(tmp_path / "results")
    empty = contract.schema.create_empty()
    with store.open_generation("folder/run", "0" * 16) as generation:
        generation.write_table(contract.name, pl.DataFrame(empty))
        manifest = generation.commit({})
    schema = pq.read_schema(manifest.path(contract.name))
    assert schema.metadata[b"contract"].decode() == contract.name
    for field in schema:
        told = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
        assert contract.metadata_of(field.name).items() <= told.items()


WHO = {"run": "r", "dataset": "d", "vehicle": "v", "terrain": "t"}
TIMES = {"t": 0.0, "stamp": 1, "log_time": 1}
POSE = {
    **WHO, **TIMES, "segment": 0, "x": 0.0, "y": 0.0, "z": 0.0,
    "q_x": 0.0, "q_y": 0.0, "q_z": 0.0, "q_w": 1.0, "latency": 0.0, "outlier": False,
    "held": False, "corrected": False, "active": True,
}  # fmt: skip
DRIVE = {**WHO, **TIMES, "left": 1.0, "right": 1.0, "speed": None, "steering": None, "active": True}
WHEEL = {**DRIVE, "latency": 0.0}
COMMAND = {
    **DRIVE, "body_x": None, "body_w": None, "left_aligned": 1.0, "right_aligned": 1.0, "speed_aligned": None,
    "followed": True,
}  # fmt: skip
SLIP = {
    **WHO, "input": "command", "t": 0.0, "stamp": 1, "segment": 0, "step": 0, "transitory": False,
    "f_x": 1.0, "f_y": 0.0, "f_w": 0.5, "v_x": 0.8, "v_y": 0.0, "v_w": 0.5,
    "g_x": 0.2, "g_y": 0.0, "g_w": 0.0, "modulus": 0.2, "suspect": False, "standing": False,
}  # fmt: skip
FINDING = {
    **WHO, "stage": "slip", "id": "pose_gap", "severity": "info", "text": "a hole",
    "where": "", "values": "{}",
    "t_start": None, "t_end": None, "value": None, "count": 1,
}  # fmt: skip
WINDOW = {
    **WHO, "input": "command", "t_start": 0.0, "t_end": 2.0, "segment": 0, "step": 0, "transitory": True,
    "suspect": False, "standing": False, "samples": 40, "rms_modulus": 0.1, "window_norm": 0.632,
}  # fmt: skip


def broken_rows(table: str, row: dict[str, object]) -> int:
    schema = contract_of(table).schema
    frame = pl.DataFrame([row], schema=schema.create_empty().schema, orient="row")
    _, failure = schema.filter(frame)
    return len(failure)


def test_a_good_row_is_kept() -> None:
    for table, row in [
        ("poses", POSE),
        ("wheels", WHEEL),
        ("commands", COMMAND),
        ("slip", SLIP),
        ("findings", FINDING),
        ("windows", WINDOW),
    ]:
        assert broken_rows(table, row) == 0


NAN, INF = float("nan"), float("inf")


def test_a_bad_row_is_told() -> None:
    for table, row, change in [
        ("poses", POSE, {"q_w": 0.0}),
        ("poses", POSE, {"q_w": 0.9}),
        ("poses", POSE, {"x": NAN}),
        ("poses", POSE, {"y": INF}),
        ("poses", POSE, {"segment": -1}),
        ("poses", POSE, {"held": None}),
        ("wheels", WHEEL, {"left": NAN}),
        ("wheels", WHEEL, {"left": None}),
        ("wheels", WHEEL, {"left": None, "right": None}),
        ("wheels", WHEEL, {"left": None, "right": None, "speed": 1.0}),
        ("commands", COMMAND, {"right": INF}),
        ("slip", SLIP, {"g_x": 0.3}),
        ("slip", SLIP, {"modulus": -0.1}),
        ("slip", SLIP, {"v_y": NAN, "g_y": NAN}),
        ("findings", FINDING, {"id": "Pose gap"}),
        ("findings", FINDING, {"text": ""}),
        ("findings", FINDING, {"count": -1}),
        ("windows", WINDOW, {"samples": 0}),
        ("windows", WINDOW, {"window_norm": -1.0}),
        ("windows", WINDOW, {"window_norm": NAN}),
    ]:
        assert broken_rows(table, {**row, **change}) == 1


def test_a_car_has_speed_and_steering_in_place_of_wheels() -> None:
    car = {**WHEEL, "left": None, "right": None, "speed": 1.0, "steering": 0.1}
    assert broken_rows("wheels", car) == 0
