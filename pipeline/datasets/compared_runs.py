"""Selection of the runs of the results that can be compared, with the reasons for exclusions."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import polars as pl

from pipeline.core import group_by, guess_names, name_first
from pipeline.datasets.corrections import note_corrections
from pipeline.datasets.pooling import (
    ComparisonError,
    add_measures,
    find_unrelated,
    gather_runs,
    label_runs,
    measure_difficulty,
)
from pipeline.datasets.robots import note_robots
from pipeline.estimation.stored_diagnosis import DIAGNOSED
from pipeline.results import FATAL
from pipeline.run import GROUND_UNOBSERVABLE
from pipeline.stages import WRONG_RADIUS, find_gain_of, is_grip
from pipeline.store import DIAGNOSIS, Manifest, Store, StoreError, date_runs
from schemas import contract_of

_DATES = ("day", "month", "year")
_TABLES = ("aggregates", "slip")
_SCHEMA = {
    "run": pl.String,
    "key": pl.String,
    "dataset": pl.String,
    "vehicle": pl.String,
    "terrain": pl.String,
    "day": pl.String,
    "start": pl.Int64,
    "mass": pl.Float64,
    "squared_gyration": pl.Float64,
}


@dataclass(frozen=True)
class ComparedRuns:
    """Runs to compare.

    Attributes:
        labels: one row per run: labels, ``key``, ``group``, ``mass`` [kg], ``squared_gyration`` [m^2].
        manifests: their generations by run.
        store: the results.
        notes: runs of one vehicle that are of several robots or were corrected in different ways; excluded
            runs with the reasons.
        refusals: reasons why slip is not observable, by run.
        date_notes: contradictory dates, and runs whose order is not known.
        total: number of runs that could count: all of the results, or those that were asked for.
    """

    labels: pl.DataFrame
    manifests: Mapping[str, Manifest]
    store: Store
    notes: tuple[str, ...]
    refusals: Mapping[str, str] = field(default_factory=dict)
    date_notes: tuple[str, ...] = ()
    total: int = 0

    def count_omitted(self, number: int) -> tuple[str, ...]:
        """A note that stands before those on what is left out: how many runs, if not all count."""
        omitted = self.total - number
        return (f"left out: {omitted} of the {self.total} runs in the results",) if omitted > 0 else ()

    @property
    def keys(self) -> tuple[str, ...]:
        """Run/generation of every run."""
        return tuple(f"{run}/{manifest.key}" for run, manifest in sorted(self.manifests.items()))

    def scan(self, table: str) -> pl.LazyFrame:
        """Rows of a table of these runs."""
        rows = self.store.scan(table, list(self.manifests.values()))
        return rows.filter(pl.col("run").is_in(list(self.manifests)))

    def read_estimates(self) -> pl.DataFrame:
        """Rows of `estimates` of effects as they are in the catalogue: older runs may have others."""
        from pipeline.models import list_effects  # noqa: PLC0415 - heavy

        known = [f"{effect.id}.{number.name}" for effect in list_effects() for number in effect.parameters]
        label = pl.concat_str(pl.col("effect", "parameter").cast(pl.String), separator=".")
        return self.scan("estimates").filter(label.is_in(known).all().over("run", "effect")).collect()


def find_material(
    store: Store,
    by: Sequence[str],
    *,
    trusted_only: bool,
    tables: Sequence[str] = _TABLES,
    optional: Sequence[str] = (),
    vehicle: str = "",
) -> ComparedRuns:
    """Select the current runs of the results, each recording once.

    Excluded with a note are runs with a damaged table, whichever it is, duplicates of a recording, tables
    of another contract version, runs without a group, and runs without a pose, whose slip is that of the
    wheels against their commands; with ``trusted_only`` also runs with a finding
    that forbids conclusions. Simulated runs are left out where there are recordings. With ``trusted_only``
    the first notes are on runs of one vehicle that are of several robots or were corrected in different ways.

    Args:
        store: the results.
        by: columns that define a group.
        trusted_only: whether findings of severity `error` exclude a run.
        tables: tables that a run must have.
        optional: tables that a run need not have, but whose file may not be missing if it does; with
            ``trusted_only`` these include the findings.
        vehicle: the one that is asked about, if there is one of it: nothing is noted on runs of others.

    Raises:
        ComparisonError: ``by`` names no column.
    """
    optional = (*optional, "findings") if trusted_only else optional
    survey = store.survey()
    notes = [f"left out, damaged: {error}" for error in survey.errors]
    total = len(survey.manifests) + len(survey.errors)
    reasons: dict[str, list[str]] = {}
    manifests: dict[str, Manifest] = {}
    holders: dict[str, str] = {}
    refusals: dict[str, str] = {}
    for manifest in survey.manifests:
        digest = read_digest(manifest)
        reason = _doubt(manifest, tables) or _describe_damage(manifest, (*tables, *optional))
        if refusal := find_run_refusal(manifest):
            refusals[manifest.run] = refusal
            reason = reason and f"no effect can be estimated: {refusal}"
        if not reason and _lacks_pose(manifest):
            reason = "its log holds no pose, and its slip is not that of the ground"
        if digest in holders:
            reason = f"the same recording as {holders[digest]}"
        if reason:
            if not vehicle or manifest.part("vehicle").get("id") in (vehicle, None):
                reasons.setdefault(reason, []).append(manifest.run)
            continue
        holders[digest] = manifest.run
        manifests[manifest.run] = manifest
    notes += [_note_left_out(reason, runs) for reason, runs in reasons.items()]
    # Runs that are left out date the others all the same.
    days = date_runs({manifest.run: manifest.start_ns for manifest in survey.manifests}).days
    date_notes = date_runs({run: manifest.start_ns for run, manifest in manifests.items()}).notes
    notes += date_notes if not {*by}.isdisjoint(_DATES) else ()
    labelled = [_label_run(manifest, days[run]) for run, manifest in manifests.items()]
    rows = pl.DataFrame(labelled, schema=_SCHEMA, orient="row")
    dated = rows.with_columns(
        pl.col("day").str.slice(0, 7).alias("month"), pl.col("day").str.slice(0, 4).alias("year")
    )
    labels = label_runs(dated, by)
    compared = ComparedRuns(labels, manifests, store, tuple(notes), refusals, date_notes, total)
    if vehicle in set(labels["vehicle"]):
        compared = choose_runs(compared, vehicle, ())
    reason = f"{' and '.join(by)} unknown, not pooled"
    compared = _leave_out(compared, pl.col("group").is_null(), reason)
    compared = _leave_out_untrusted(compared) if trusted_only else compared
    simulated = [run for run, manifest in compared.manifests.items() if manifest.details.get("simulated")]
    if len(simulated) < len(compared.manifests):
        reason = "simulated, and never pooled with recordings"
        compared = _leave_out(compared, pl.col("run").is_in(simulated), reason)
    if not trusted_only:
        return compared
    selected = compared.manifests.values()
    return replace(
        compared, notes=(*note_robots(selected), *note_corrections(store, selected), *compared.notes)
    )


def choose_runs(compared: ComparedRuns, vehicle: str, groups: Sequence[str]) -> ComparedRuns:
    """Restrict a comparison to the runs that a user named; nothing is noted on the others.

    Args:
        compared: the runs.
        vehicle: of these runs; of any if empty.
        groups: at least two; all if empty.

    Raises:
        ComparisonError: ``no_such_vehicle``, ``no_such_dataset``, or ``nothing_to_compare``: one dataset.
    """
    rows = compared.labels
    if vehicle:
        known = sorted(set(rows["vehicle"]))
        if vehicle not in known:
            hint = f"{guess_names(vehicle, known)}There are runs of: {', '.join(known) or 'no vehicle'}."
            raise ComparisonError("no_such_vehicle", f"no run is of {vehicle}", hint=hint)
        rows = rows.filter(pl.col("vehicle") == vehicle)
    known = sorted(set(rows["group"]))
    for group in groups:
        if group not in known:
            hint = f"{guess_names(group, known)}There are: {', '.join(known) or 'none'}."
            raise ComparisonError("no_such_dataset", f"no dataset is called {group}", hint=hint)
    if len(set(groups)) == 1:
        hint = "Name another one, too, or none to compare all."
        raise ComparisonError("nothing_to_compare", f"{groups[0]} is one dataset", hint=hint)
    rows = rows.filter(pl.col("group").is_in(list(groups))) if groups else rows
    runs = set(rows["run"])
    manifests = {run: manifest for run, manifest in compared.manifests.items() if run in runs}
    total = len(manifests) if vehicle or groups else compared.total
    return replace(compared, labels=rows, manifests=manifests, total=total)


def keep_runs(compared: ComparedRuns, runs: Sequence[str], reason: str) -> ComparedRuns:
    """Restrict the comparison to these runs, with a note on the others."""
    return _leave_out(compared, ~pl.col("run").is_in(list(runs)), reason)


def _leave_out(compared: ComparedRuns, which: pl.Expr, reason: str) -> ComparedRuns:
    gone = compared.labels.filter(which)["run"].to_list()
    if not gone:
        return compared
    remaining = {run: manifest for run, manifest in compared.manifests.items() if run not in set(gone)}
    notes = (*compared.notes, _note_left_out(reason, gone))
    return replace(compared, labels=compared.labels.filter(~which), manifests=remaining, notes=notes)


def _note_left_out(reason: str, runs: Sequence[str]) -> str:
    count = f" ({len(runs)} runs)" if len(runs) > 1 else ""
    return f"left out, {reason}{count}: {name_first(runs)}"


def _leave_out_untrusted(compared: ComparedRuns) -> ComparedRuns:
    for run, refusal in compared.refusals.items():
        compared = _leave_out(compared, pl.col("run") == run, refusal)
    if not compared.manifests:
        return compared
    grave = (
        compared.scan("findings")
        .filter(pl.col("severity") == "error")
        .select("run", "id")
        .unique()
        .sort("run", "id")
        .collect()
    )
    slippery = _find_slippery(compared) if WRONG_RADIUS in set(grave["id"]) else []
    if slippery:
        reason = "slippery ground and no wrong wheel radius, by other runs of the same vehicle"
        compared = replace(compared, notes=(*compared.notes, f"{reason}: {name_first(slippery)}"))
    is_grip = (pl.col("id") == WRONG_RADIUS) & pl.col("run").is_in(slippery)
    for (finding,), rows in sorted(grave.filter(~is_grip).partition_by("id", as_dict=True).items()):
        compared = _leave_out(compared, pl.col("run").is_in(rows["run"].to_list()), f"finding {finding}")
    return compared


def _find_slippery(compared: ComparedRuns) -> list[str]:
    """Runs whose finding of a wrong wheel radius other runs with the same data sheet contradict."""
    sheets = {
        run: str([manifest.part("vehicle").get(key) for key in ("id", "name", "wheel_radius_m")])
        for run, manifest in compared.manifests.items()
    }
    claims = compared.scan("findings").filter(pl.col("id") == WRONG_RADIUS).select("run", "value").collect()
    claimed = {run: value for run, value in claims.iter_rows() if value is not None}
    asked = {sheets[run] for run in claimed}
    siblings = [
        manifest
        for run, manifest in compared.manifests.items()
        if sheets[run] in asked and run not in claimed and not manifest.find_damage(["slip"])
    ]
    driven = (
        compared.store.scan("slip", siblings)
        .select("run", "input", "suspect", "f_x", "v_x", "transitory")
        .collect()
    )
    gains = group_by(
        (sheets[str(run)], gain)
        for (run,), rows in driven.partition_by("run", as_dict=True).items()
        if (gain := find_gain_of(rows)) is not None
    )
    slippery = []
    for run, value in sorted(claimed.items()):
        radius = compared.manifests[run].part("vehicle").get("wheel_radius_m")
        if isinstance(radius, (int, float)) and is_grip(value / radius, gains.get(sheets[run], [])):
            slippery.append(run)
    return slippery


def _doubt(manifest: Manifest, tables: Sequence[str]) -> str:
    """Reason why a run's tables cannot be compared; empty if they can."""
    for name in tables:
        entry = manifest.tables.get(name)
        if entry is None:
            if name in DIAGNOSED and DIAGNOSIS in manifest.files:
                return _explain_empty(manifest)
            if name in DIAGNOSED:
                return "it was not diagnosed; slip batch LOGS --diagnosis does that"
            return f"it has no table {name}; analyze its log again"
        if entry.contract_version != contract_of(name).version:
            return (
                f"its table {name} has contract version {entry.contract_version} instead of "
                f"{contract_of(name).version}; analyze its log again"
            )
    return ""


def _explain_empty(manifest: Manifest) -> str:
    """Reason why a diagnosis gave no numbers."""
    try:
        findings = manifest.read_json(DIAGNOSIS).get("findings")
    except StoreError:
        findings = None
    ids = [one.get("id") for one in findings if isinstance(one, dict)] if isinstance(findings, list) else []
    if "slow_poses" in ids:
        return "its poses are too slow to be diagnosed"
    return "too short to be diagnosed alone" if "too_short" in ids else "its diagnosis gave no numbers"


def find_run_refusal(manifest: Manifest) -> str:
    """Reason why slip is not observable in a run; empty if it is."""
    if "findings" not in manifest.tables or manifest.find_damage(["findings"]):
        return ""
    refused = manifest.read("findings").filter(pl.col("id").is_in(FATAL))
    return "" if refused.is_empty() else str(refused["text"][0])


def _lacks_pose(manifest: Manifest) -> bool:
    """Whether the poses of a run are the motion of its wheels; False if its findings are damaged."""
    if "findings" not in manifest.tables or manifest.find_damage(["findings"]):
        return False
    return GROUND_UNOBSERVABLE in manifest.read("findings")["id"]


def _describe_damage(manifest: Manifest, needed: Sequence[str]) -> str:
    """What is wrong with the first damaged table of a run, and what to do; empty if all are intact."""
    damage = manifest.find_damage(needed)
    return f"{damage.what}; {damage.hint[0].lower()}{damage.hint[1:]}" if damage else ""


def read_digest(manifest: Manifest) -> str:
    """SHA-256 of the log of a run; the name of the run if that is unknown."""
    log = manifest.details.get("log")
    return str(log.get("sha256")) if isinstance(log, dict) else manifest.run


def _label_run(manifest: Manifest, day: str | None) -> dict[str, str | float | int | None]:
    details, facts = manifest.details, manifest.part("vehicle")
    mass = facts.get("mass_kg")
    return {
        "run": manifest.run,
        "key": manifest.key,
        "dataset": str(details.get("dataset") or "unknown"),
        "vehicle": str(facts.get("id") or "unknown"),
        "terrain": str(details.get("terrain") or "unknown"),
        "day": day,
        "start": manifest.start_ns,
        "mass": float(mass) if isinstance(mass, (int, float)) else None,
        "squared_gyration": _square_gyration(facts),
    }


def _square_gyration(vehicle: Mapping[str, object]) -> float | None:
    """Yaw inertia divided by mass [m^2] of a plate as wide as the track and as long as the wheelbase."""
    sides = [vehicle.get(name) for name in ("track_width_m", "wheelbase_m")]
    known = [float(side) for side in sides if isinstance(side, (int, float))]
    return (known[0] ** 2 + known[-1] ** 2) / 12.0 if known else None


NOT_VALID = (
    "plain p (p_uncorrected) is the Mann-Whitney test of published work over all samples; it is not valid "
    "here, because samples of one run are correlated"
)


@dataclass(frozen=True)
class Question:
    """Options of a comparison.

    Attributes:
        by: columns that define a dataset.
        input: input u; None: both, the command first if every run has one.
        as_published: compare the window norms of the published chain instead of the median slip modulus.
        datasets: compare only these, each with every other; if empty all, and those of one vehicle with each
            other.
        vehicle: compare only runs of this vehicle; of any if empty.
    """

    by: tuple[str, ...] = ("dataset",)
    input: str | None = None
    as_published: bool = False
    datasets: tuple[str, ...] = ()
    vehicle: str = ""


def find_untested(compared: ComparedRuns, question: Question) -> frozenset[frozenset[str]]:
    """Pairs of datasets without a test; none where datasets are named."""
    return frozenset() if question.datasets else find_unrelated(compared.labels)


def note_untested(untested: Collection[frozenset[str]]) -> list[str]:
    """The note on pairs of datasets without a test."""
    if not untested:
        return []
    first, second = sorted(min(untested, key=sorted))
    pairs = f"{len(untested)} pairs" if len(untested) > 1 else "1 pair"
    why = "of different vehicles"
    return [f"{pairs} of datasets {why}: no test, unless named, as in: slip compare {first} {second}"]


def measure_runs(compared: ComparedRuns) -> tuple[ComparedRuns, pl.DataFrame, list[str]]:
    """Comparable runs, all measures with one row per run and input, and notes."""
    compared, runs, notes = _agree_on_scale(compared, _gather(compared))
    if runs.is_empty():
        return compared, runs, notes
    scales = runs.unique("run").select("run", "length_scale")
    vehicles = compared.labels.select("run", "mass", "squared_gyration").join(scales, on="run")
    return compared, add_measures(runs, measure_difficulty(compared.scan("slip"), vehicles)), notes


def _gather(compared: ComparedRuns) -> pl.DataFrame:
    if not compared.manifests:
        return pl.DataFrame()
    return gather_runs(compared.scan("aggregates").collect(), compared.labels).filter(
        pl.col("median_modulus").is_not_null(), pl.col("median_modulus").is_finite()
    )


def _agree_on_scale(
    compared: ComparedRuns, runs: pl.DataFrame
) -> tuple[ComparedRuns, pl.DataFrame, list[str]]:
    """Exclude runs whose length scale differs from that of most runs: their moduli are not comparable."""
    if runs.is_empty():
        return compared, runs, []
    scales = runs.unique("run")["length_scale"]
    usual = float(np.min(scales.drop_nulls().mode().to_numpy()))
    valid = runs.filter(pl.col("length_scale") == usual)["run"].unique().to_list()
    compared = keep_runs(
        compared, valid, f"its length scale is not the {usual:g} m of most runs, or it has no slip"
    )
    return compared, runs.filter(pl.col("run").is_in(valid)), [NOT_VALID]


def choose_input(runs: pl.DataFrame) -> str:
    """Default input u: the command if every run has one, else the measured wheels."""
    on_command = runs.filter(pl.col("input") == "command")["run"].n_unique()
    return "command" if on_command == runs["run"].n_unique() else "measured"
