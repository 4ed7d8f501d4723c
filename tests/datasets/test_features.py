"""Features of deployments: what is shared, and what of a file of others is taken."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from comparison_store import Run, write_run
from verbs import ask_verb, print_verb

from pipeline.datasets import ComparisonError
from pipeline.datasets.deployments import draw_up_map
from pipeline.datasets.features import gather_features, merge_features, read_features, write_features
from pipeline.store import Store

PLACE = "/home/somebody/secret_farm"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    made = Store(tmp_path_factory.mktemp("results"))
    for number, terrain in enumerate(("gravel", "ice")):
        write_run(
            made,
            Run(
                name=f"secret_farm/run_{number}", dataset=f"warthog_{terrain}", terrain=terrain,
                sha256=f"{number}" * 64, seconds=60.0,
            ),
            seed=number,
        )  # fmt: skip
    return made


@pytest.fixture
def features(store: Store) -> pl.DataFrame:
    return gather_features(store)[0]


def refused(path: Path) -> str:
    with pytest.raises(ComparisonError) as told:
        read_features(path)
    assert told.value.code == "bad_features"
    assert "\n" not in str(told.value)
    return str(told.value)


def test_features_come_back_as_they_were_shared(features: pl.DataFrame, store: Store, tmp_path: Path) -> None:
    path = tmp_path / "features.parquet"
    write_features(features, path)
    assert read_features(path).equals(features)
    assert features.height == 4
    compared = store.read("secret_farm/run_0", "aggregates").filter(
        pl.col("input") == "command", pl.col("subset") == "all"
    )
    own = features.filter(pl.col("sha256") == "0" * 64, pl.col("input") == "command")
    assert own["median_modulus"].item() == compared["median_modulus"].item()
    assert b"secret_farm" not in path.read_bytes()


def test_the_verbs_share_merge_and_draw(store: Store, tmp_path: Path) -> None:
    first, merged = tmp_path / "a.parquet", tmp_path / "b.parquet"
    print_verb("fleet", "share", store.root, "--file", first, "--quiet")
    told = ask_verb("fleet", "map", "merge", first, first, "--file", merged)
    assert told == {"file": str(merged), "runs": 2, "rows": 4, "twice": 4}
    alone = draw_up_map(Store(tmp_path / "none"), shared=read_features(merged))
    assert alone.own["dataset"].to_list() == ["warthog_gravel (shared)", "warthog_ice (shared)"]
    assert "2 of 2 shared runs drawn" in alone.notes
    # Own logs do not stand on the map twice.
    beside = draw_up_map(store, shared=read_features(merged))
    assert beside.own["dataset"].to_list() == ["warthog_gravel", "warthog_ice"]
    assert "0 of 2 shared runs drawn; 2 of them are of your own logs and count once" in beside.notes


def test_a_merge_writes_where_it_is_told(
    features: pl.DataFrame, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_features(features, Path("a.parquet"))
    for asked, written in (([], "features.parquet"), (["--file", "deployments.csv"], "deployments.csv")):
        print_verb("fleet", "map", "merge", "a.parquet", "a.parquet", "--quiet", *asked)
        assert read_features(Path(written)).equals(features)
        Path(written).unlink()


def test_a_log_counts_once_and_the_later_version_counts(features: pl.DataFrame) -> None:
    newer = features.with_columns(pl.lit("99.0.10").alias("made_by"), pl.col("median_modulus") * 2.0)
    older = features.with_columns(pl.lit("99.0.9").alias("made_by"))
    hostile = features.with_columns(pl.lit("9" * 40).alias("made_by"))
    assert merge_features([hostile, features], "")[0].equals(hostile)
    for order in ([newer, older], [older, newer]):
        merged, twice = merge_features(order, "")
        assert merged.equals(newer.sort("sha256", "input"))
        assert twice == 4
    again = features.with_columns(pl.lit("other").alias("from_results"))
    for order in ([features, again], [again, features]):
        merged, twice = merge_features(order, "")
        assert (merged.height, twice) == (4, 4)
        assert merged.equals(merge_features(order[::-1], "")[0])
    changed = features.with_columns(pl.col("median_modulus") * 2.0, pl.lit(None, pl.Float64).alias("mass"))
    with pytest.raises(ComparisonError, match=r"on the logs 0000.*, in mass, median_modulus\. "):
        merge_features([again, changed], "a and b")


def test_runs_without_a_mass_are_shared(tmp_path: Path) -> None:
    made = Store(tmp_path)
    write_run(made, Run(name="light", sha256="a" * 64, mass_kg=None))
    write_run(made, Run(name="of_no_size", terrain="ice", sha256="b" * 64, sized=False))
    shared = gather_features(made)[0].filter(input="command")
    assert shared["mass"].to_list() == [None, 470.0]
    assert shared["inertia"].to_list() == [None, None]
    assert shared["lost_energy"].is_null().to_list() == [False, True]


def table_of(path: Path) -> pa.Table:
    return pq.read_table(path)


def with_column(name: str, values: object) -> Callable[[pa.Table], pa.Table]:
    def change(table: pa.Table) -> pa.Table:
        place = table.schema.get_field_index(name)
        field = table.schema.field(name)
        return table.set_column(place, field, pa.array([values] * table.num_rows, field.type))

    return change


def with_type(table: pa.Table) -> pa.Table:
    place = table.schema.get_field_index("mass")
    return table.set_column(place, "mass", pa.array(["1"] * table.num_rows))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (with_column("mass", -1.0), "rows break the contract (mass|min)"),
        (with_column("median_modulus", float("nan")), "rows break the contract"),
        (with_column("median_modulus", float("inf")), "rows break the contract"),
        (with_column("vehicle", PLACE), "rows break the contract (vehicle|regex)"),
        (with_column("vehicle", "x" * 1_000), "rows break the contract"),
        (with_column("terrain", "ice\x1b[2J"), "rows break the contract"),
        (with_column("sha256", "0" * 63), "rows break the contract"),
        (with_column("samples", 10**15), "rows break the contract"),
        (with_column("run", "0" * 15 + "f"), "run_is_the_beginning_of_the_hash"),
        (with_type, "column mass is string instead of double"),
        (lambda table: table.drop_columns(["mass"]), "column mass is missing"),
        (lambda table: table.append_column("r\naw", table.column("mass")), "column r aw is unknown"),
        (lambda table: table.append_column("mass", table.column("mass")), "it cannot be read"),
        (lambda table: table.replace_schema_metadata({"contract": "features", "contract_version": "99"}),
         "it is of version 99 of the table `features`, not of 1"),
        (lambda table: table.replace_schema_metadata({}), "it is not a table of features"),
        (lambda table: pa.concat_tables([table] * 30_000), "it has 120000 rows, more than 100000"),
    ],
)  # fmt: skip
def test_what_breaks_the_contract_is_refused(
    change: Callable[[pa.Table], pa.Table], why: str, features: pl.DataFrame, tmp_path: Path
) -> None:
    path = tmp_path / "f.parquet"
    write_features(features, path)
    pq.write_table(change(table_of(path)), path)
    assert why in refused(path)
    assert str(path) in refused(path)
    assert "slip fleet share" in refused(path)


def test_features_that_another_program_wrote_are_taken(features: pl.DataFrame, tmp_path: Path) -> None:
    path = tmp_path / "f.parquet"
    about = {"contract": "features", "contract_version": "1"}
    features.select(sorted(features.columns)).write_parquet(path, metadata=about)
    assert read_features(path).equals(features)


def test_what_is_no_whole_parquet_file_is_refused_at_once(features: pl.DataFrame, tmp_path: Path) -> None:
    pipe, cut, text = tmp_path / "pipe", tmp_path / "cut", tmp_path / "text"
    os.mkfifo(pipe)
    write_features(features, cut)
    cut.write_bytes(cut.read_bytes()[:-100])
    text.write_text("key,year\n")
    for path in (pipe, tmp_path, tmp_path / "none"):
        assert "there is no such file" in refused(path)
    for path in (cut, text):
        assert "it cannot be read: Parquet magic bytes not found" in refused(path)


def test_damage_anywhere_is_refused_or_changes_nothing_but_values_in_range(
    features: pl.DataFrame, tmp_path: Path
) -> None:
    path = tmp_path / "f.parquet"
    write_features(features, path)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    refusals = 0
    for trial in range(400):
        data = bytearray(whole)
        if trial % 4 == 0:
            data = data[: int(rng.integers(4, len(data)))]
        else:
            for place in rng.integers(4, len(data), 1 + trial % 3):
                data[place] ^= int(rng.integers(1, 256))
        path.write_bytes(data)
        try:
            read = read_features(path)
        except ComparisonError as error:
            refusals += error.code == "bad_features"
        else:
            assert read.schema == features.schema
    assert refusals > 150
