"""Python's face: the numbers of the command line, tables, charts, and errors of one line."""

import json
import sys
from pathlib import Path
from typing import Any

import polars as pl
import pyarrow.parquet as pq
import pytest
from drawn_diagnoses import draw_diagnosis
from msgspec.structs import replace
from verbs import ask_verb

import slip
from pipeline.results import Unexplained
from pipeline.simulate import simulate_case
from pipeline.words import diagnosis_as_json
from pipeline.words.diagnosis import describe
from pipeline.words.effects import format_numbers

EFFECT = "effective_track"
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> slip.Run:
    folder = tmp_path_factory.mktemp("face")
    log = simulate_case("husky_tile", out=folder / "<b>field" / "run.mcap", duration_s=40.0)
    return slip.analyze(log, results=folder / "results", report=False, diagnosis=False)


@pytest.fixture(scope="module")
def diagnosis(run: slip.Run) -> slip.Diagnosis:
    return run.diagnose()


def ask(run: slip.Run, *words: str) -> dict[str, Any]:
    """The JSON object of a verb."""
    return ask_verb(*words, "--results", find_results(run))


def find_results(run: slip.Run) -> Path:
    return run.manifest.folder.parents[3]


def as_json(content: object) -> object:
    return json.loads(json.dumps(content))


def test_a_diagnosis_is_that_of_the_command_line(
    run: slip.Run,
    diagnosis: slip.Diagnosis,
) -> None:
    (told,) = ask(run, "diagnose", run.name)["runs"]

    assert as_json(diagnosis.to_json()) == told
    assert diagnosis.effects["effect"].to_list() == [effect["id"] for effect in told["effects"]]
    number = diagnosis.parameters.row(by_predicate=pl.col("parameter") == f"{EFFECT}.k", named=True)
    (effect,) = (one for one in told["effects"] if one["id"] == EFFECT)
    assert {key: number[key] for key in ("value", "low", "high", "unit")} == {
        key: effect["parameters"]["k"][key] for key in ("value", "low", "high", "unit")
    }
    assert dict(diagnosis.effects.select("effect", "sentence").iter_rows())[EFFECT] == effect["sentence"]
    assert diagnosis.ladder["t_mrmse_m"].to_list() == [rung["t_mrmse_m"] for rung in told["ladder"]]


def test_a_suggested_formula_is_an_effect_to_add(run: slip.Run, diagnosis: slip.Diagnosis) -> None:
    assert diagnosis.suggestion is None
    formula = '[[effect]]\nid = "found"\nv_y = "k * v0"\nk = {value = 0.1, unit = "1", bounds = [-1, 1]}\n'
    told = replace(diagnosis._diagnosis, unexplained=Unexplained(formula=formula))
    found = slip.Diagnosis(told, {}, dict)
    assert found.suggestion is not None
    fit = (slip.Model(run.vehicle.id) + found.suggestion).fit(run)
    assert "found.k" in repr(fit)


def test_what_a_suggested_formula_leaves_is_one_number_on_every_face(tmp_path: Path) -> None:
    log = ROOT / "data_samples" / "mystery_3.mcap"
    run = slip.analyze(log, results=tmp_path / "results", report=False)
    diagnosis = run.diagnose()
    told = diagnosis.to_json()["unexplained"]
    (model, suggestion) = (diagnosis.model, diagnosis.suggestion)
    assert model is not None
    assert suggestion is not None
    errors = (model + suggestion).fit(run).errors
    assert isinstance(told, dict)
    best = model.missing(run).row(0, named=True)
    assert best["effect"] == suggestion.id
    for key in ("t_mrmse_m", "r_mrmse_rad"):
        assert told["with_formula"][key] == pytest.approx(errors[key], rel=1e-4)
        assert best[key] == pytest.approx(errors[key], rel=1e-4)


@pytest.mark.parametrize(
    ("name", "values", "said"),
    [
        ("clock_offset", ({"d": 0.252}, {"d": -0.02}), "stamped 20 ms early to 0.25 s late"),
        ("effective_track", ({"k": 2.0}, {"k": 1.25}), "50 to 80 %"),
        ("turn_lag", ({"tau_mean": 0.2, "tau_diff": 0.4}, {"tau_mean": 0.3, "tau_diff": 0.1}), "differ"),
    ],
)
def test_what_runs_have_of_their_own_is_of_every_run_on_every_face(
    name: str, values: tuple[dict[str, float], ...], said: str
) -> None:
    errors = [(1.0, 0.5), (0.05, 0.02)]
    drawn = draw_diagnosis({name: values[0]}, errors, joint=["field/a", "field/b"], input="command")
    (effect,) = drawn.effects
    by_run = tuple(
        {
            key: replace(effect.parameters[key], value=value, low=value, high=value)
            for key, value in own.items()
        }
        for own in values
    )
    told = slip.Diagnosis(replace(drawn, effects=(replace(effect, by_run=by_run),)), {}, dict)

    assert list(told.parameters.select("parameter", "run", "value").iter_rows()) == [
        (f"{name}.{key}", run, own[key])
        for key in values[0]
        for run, own in zip(drawn.joint, values, strict=True)
    ]
    assert said in str(told.effects["sentence"].item())
    runs = [
        replace(drawn, run=run, effects=(replace(effect, parameters=own, by_run=by_run),))
        for run, own in zip(drawn.joint, by_run, strict=True)
    ]
    assert {diagnosis_as_json(one)["effects"][0]["sentence"] for one in runs} == {
        told.effects["sentence"].item()
    }
    screen = describe(runs, everything=True)
    assert said in screen
    for run, own in zip(drawn.joint, by_run, strict=True):
        assert f"{format_numbers(own)} in {run}" in screen
    low, high = sorted(own[next(iter(own))] for own in values)
    assert f"{low:.3g} to {high:.3g}" in describe(runs)


def test_what_the_analysis_found_is_not_looked_for_again(
    run: slip.Run, diagnosis: slip.Diagnosis, monkeypatch: pytest.MonkeyPatch
) -> None:
    where = {"results": find_results(run), "report": False}
    again = slip.analyze(str(run.summary["log"]["path"]), **where)  # type: ignore[index, arg-type]
    monkeypatch.setattr("pipeline.api.diagnoses.diagnose_runs", None)
    assert as_json(again.diagnose().to_json()) == as_json(diagnosis.to_json())
    assert repr(again.diagnose()) == repr(diagnosis)


def test_a_fit_is_that_of_the_command_line(
    run: slip.Run,
    tmp_path: Path,
) -> None:
    model = slip.Model("husky_a200") + slip.effect(EFFECT)
    path = tmp_path / "husky.toml"
    model.write(path)
    fit = model.fit(run, input="measured")
    told = ask(run, "model", "fit", str(path), "--on", run.name, "--input", "measured")

    content = json.loads(json.dumps(fit.to_json()))
    assert content == {key: told[key] for key in content}
    assert set(told) - set(content) == {"model", "carried_over", "warnings"}
    assert fit.errors == told["by_run"][run.name]
    assert slip.Model.read(path).parameters.equals(fit.model.parameters)
    fit.model.write(tmp_path / "again.toml")
    assert (tmp_path / "again.toml").read_text() == path.read_text()
    assert slip.Model.read(path).export("python").startswith('"""')

    compared = ask(run, "model", "compare", str(path), str(path), "--on", run.name)["compared"][0]
    errors = slip.Model.read(path).errors(run)  # with the six digits of the file, as `compare` reads it
    assert errors["t_mrmse_m"].to_list() == [
        compared[key]["t_mrmse_m"] for key in ("carried", "own_fit", "ideal")
    ]


def test_a_formula_is_fitted_as_the_effect_that_it_spells(run: slip.Run) -> None:
    ideal = slip.Model(run.vehicle) + EFFECT
    formula = slip.effect("skid", v_y="-c * v0 * w0", c=("s", -0.5, 0.5))
    one, other = (ideal + effect for effect in (formula, slip.effect("lateral_skid")))
    values = [model.fit(run).model.parameters["value"].to_list() for model in (one, other)]
    assert values[0] == pytest.approx(values[1], rel=1e-3)
    assert repr((one - "skid").parameters) == repr(ideal.parameters)


def test_tables_are_lazy_and_charts_hold_their_rows(run: slip.Run, diagnosis: slip.Diagnosis) -> None:
    table = run.table("slip")
    assert isinstance(table, pl.LazyFrame)
    all_runs = slip.table("slip", results=find_results(run))
    assert table.collect().height == all_runs.collect().height > 0
    charts = diagnosis.figures()
    assert {"ladder", "residuals"} <= set(charts)
    ladder = charts["ladder"].to_dict()
    assert ladder["title"] == "The error after each effect"
    rows = ladder["datasets"]["ladder"]
    assert [row["t"] for row in rows] == pytest.approx(diagnosis.ladder["t_mrmse_m"].to_list(), abs=1e-4)


def test_slip_is_an_array_with_named_axes_and_units(run: slip.Run) -> None:
    found, table = run.to_xarray(), run.slip.collect()
    assert found.sizes == {"input": 2, "t": table["t"].n_unique()}
    for (name,), rows in table.group_by("input"):
        one = found.sel(input=name).dropna("t", how="all", subset=["g_x"])
        assert one["g_x"].to_numpy().tolist() == rows.sort("t")["g_x"].to_list()
    assert found["g_w"].attrs["unit"] == "rad/s"
    assert found["t"].attrs["unit"] == "s"


def test_without_xarray_it_says_what_to_install(run: slip.Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(slip.SlipError, match="xarray is not installed"):
        run.to_xarray()


@pytest.mark.parametrize("table", ["slip", "poses"])
def test_a_table_keeps_its_units_in_arrow(run: slip.Run, table: str) -> None:
    arrow = run.to_arrow(table)
    stored = pq.read_schema(run.manifest.path(table))
    assert [field.metadata for field in arrow.schema] == [field.metadata for field in stored]
    assert b"unit" in arrow.schema.field("t").metadata
    assert pl.DataFrame(arrow).equals(run.manifest.read(table))


def test_without_pandas_it_names_the_extra(run: slip.Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(slip.SlipError, match=r"pip install 'slip-pipeline\[pandas\]'"):
        run.to_pandas()


def test_the_catalogue_is_a_table() -> None:
    found = slip.effects()
    assert {"effective_track", "drive_lag"} <= set(found["effect"])
    one = found.row(by_predicate=pl.col("effect") == "drive_lag", named=True)
    assert (one["term"], one["parameters"], one["units"]) == ("lag of the drive", ["tau"], ["s"])
    assert all(found["sentence"].str.len_chars() > 0)


def test_a_notebook_shows_names_as_text(run: slip.Run, diagnosis: slip.Diagnosis) -> None:
    assert "<b>field" in run.name
    for shown in (
        run,
        diagnosis,
        slip.Model(run.vehicle) + EFFECT,
        slip.load(run.name, results=find_results(run)),
    ):
        page = shown._repr_html_()
        assert "<table>" in page
        assert "<b>field" not in page
    assert "&lt;b&gt;field" in run._repr_html_()
    assert repr(diagnosis).startswith(f"{diagnosis.verdict}\n")


def test_a_run_has_the_verdict_of_a_diagnosis_that_was_made_later(
    run: slip.Run, diagnosis: slip.Diagnosis
) -> None:
    assert slip.load(run.name, results=find_results(run)).verdict == diagnosis.verdict


def test_what_is_wrong_is_said_in_one_line(run: slip.Run) -> None:
    for act, line in [
        (lambda _: slip.effect("effectiv_track"), "no effect is called 'effectiv_track'"),
        (lambda _: slip.effect(EFFECT, k="wide"), "'wide' is not a value of k"),
        (lambda _: slip.effect("mine", v_y="k *", k=("m/s", -1, 1)), "is not a formula"),
        (lambda _: slip.effect("mine", v_y="k * v0", k=(-1, 1)), "(-1, 1) is not a value of k"),
        (lambda _: slip.effect("my own", v_y="k * v0", k=("1", -1, 1)), "'my own' cannot be the id"),
        (lambda _: slip.effect("mine", v_y="k * v0", k=("1", 1, -1)), "bounds of k must be two numbers"),
        (lambda _: slip.effect("drive_lag", v_y="k * v0", k=("1", -1, 1)), "an effect of the catalogue is"),
        (lambda _: slip.Model("husky_a200") + 3, "3 is not an effect"),
        (lambda _: slip.Model("husky_a200").fit("run.mcap"), "'run.mcap' is not a run"),
        (lambda _: slip.Model("husky_a200").fit([]), "[] is not a run"),
        (lambda _: slip.Model("husky_a200").predict("run.mcap"), "'run.mcap' is not a run"),
        (lambda run: slip.Model("warthog").missing(run), "the run is of a Clearpath Husky A200"),
        (lambda run: run.plot("path", model="model.toml"), "'model.toml' is not a model"),
        (lambda run: run.diagnose(model="model.toml"), "'model.toml' is not a model"),
        (lambda run: run.diagnose(input="commands"), "'commands' is neither command nor measured"),
        (lambda run: run.compare_models({"mine": 3}), "3 is not a model"),
        (lambda run: run.compare_models(input="wheels"), "'wheels' is neither command nor measured"),
        (lambda _: slip.Model("hunky"), "no vehicle preset is called 'hunky'"),
        (lambda _: slip.analyze("missing.mcap"), "there is no such file"),
        (lambda run: run.table("tables"), "hold no 'tables'"),
        (lambda run: slip.load("monday", results=find_results(run)), "there is no run 'monday'"),
        (lambda run: slip.Model("warthog").fit(run), "the run is of a Clearpath Husky A200"),
    ]:
        with pytest.raises(slip.SlipError) as error:
            act(run)
        (shown,) = error.value._render_traceback_()
        assert line in shown
        assert "\n" not in shown


def test_what_a_log_lost_is_said(run: slip.Run, tmp_path: Path) -> None:
    log = run.summary["log"]
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(Path(str(log["path"])).read_bytes()[: 3 * int(log["bytes"]) // 4])  # type: ignore[index]
    with_losses = slip.analyze(cut, results=tmp_path / "results", report=False, diagnosis=False)
    assert repr(with_losses).endswith("the log has losses")
    assert "losses" not in repr(run)


def test_a_run_has_its_slip_its_length_and_a_figure_of_its_own(run: slip.Run) -> None:
    steps = run.slip.collect()
    assert not steps["suspect"].any()
    main = steps.filter(pl.col("input") == "command")
    assert main["modulus"].median() == pytest.approx(run.summary["median_modulus"], abs=1e-6)
    assert run.duration_s == run.summary["duration_s"]
    assert run.distance_m == run.summary["distance_m"]
    assert run.plot("trajectory").to_dict() == run.figures()["trajectory"].to_dict()
    with pytest.raises(slip.SlipError, match="no figure 'trajectories'"):
        run.plot("trajectories")


def test_a_model_predicts_the_velocities_of_a_run(run: slip.Run) -> None:
    ideal = slip.Model(run.vehicle)
    table = run.slip.filter(pl.col("input") == "command").collect()
    predicted = ideal.predict(run, input="command")
    assert predicted.columns == ["t", *(f"{kind}_{axis}" for kind in ("v", "f", "model") for axis in "xyw")]
    assert predicted["v_w"].to_list() == table["v_w"].to_list()
    fitted = (ideal + EFFECT + "drive_lag").fit(run, input="command").model
    errors = [
        model.predict(run, input="command").select((pl.col("model_w") - pl.col("v_w")).std()).item()
        for model in (ideal, fitted)
    ]
    assert errors[1] < 0.1 * errors[0]
    # The turning rate alone is what an effective track changes: the simulation has 1.8.
    turning = fitted.predict(run, input="command").filter(pl.col("f_w").abs() > 0.3)
    assert turning.select((pl.col("f_w") / pl.col("model_w")).median()).item() == pytest.approx(1.8, abs=0.1)


def test_a_model_ranks_what_it_lacks(run: slip.Run) -> None:
    ideal = slip.Model(run.vehicle)
    ranked = ideal.missing(run, input="command")
    assert ranked["effect"][0] == EFFECT
    one = ranked.row(0, named=True)
    assert one["sentence"].startswith("Effective track 0.99 m (nominal 0.55)")
    assert set(ranked["refusal"]) == {""}
    refused = ideal.missing(run, input="command", refused=True)
    assert refused.schema == ranked.schema
    assert all(refused["refusal"])
    assert EFFECT not in refused["effect"].to_list()
    with_it = (ideal + EFFECT).fit(run, input="command")
    assert one["t_mrmse_m"] == pytest.approx(with_it.errors["t_mrmse_m"], rel=1e-3)
    without = ideal.fit(run, input="command").errors["r_mrmse_rad"]
    assert one["r_removed"] == pytest.approx(1.0 - one["r_mrmse_rad"] / without, rel=1e-3)

    assert "drive_lag" in with_it.model.missing(run, input="command")["effect"].to_list()
    whole = (with_it.model + "drive_lag").fit(run, input="command").model
    assert whole.missing(run, input="command").columns == ranked.columns
    assert whole.missing(run, input="command").filter(pl.col("t_removed") > 0.2).is_empty()


def test_the_path_is_drawn_with_a_model_of_ones_own(run: slip.Run) -> None:
    ideal = slip.Model(run.vehicle)
    fitted = (ideal + EFFECT + "drive_lag").fit(run, input="command").model
    ends = []
    for model in (ideal, fitted):
        chart = run.plot("path", model=model).to_dict()
        assert chart["title"] == "Path: measured and model"
        rows = chart["datasets"]["stretch_errors"]
        ends.append(sum(((row["x"] - row["x2"]) ** 2 + (row["y"] - row["y2"]) ** 2) ** 0.5 for row in rows))
    assert ends[1] < 0.3 * ends[0]
    assert "ladder" not in run.figures(model=fitted)
