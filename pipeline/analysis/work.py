"""Execution of the stages of one run, and slip relative to a model."""

import hashlib
import inspect
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import polars as pl

from pipeline.analysis import STAGES, Options
from pipeline.core import naming_os_errors, pick, read_bounded, return_freed_memory, round_numbers
from pipeline.estimation.stored_diagnosis import add_model
from pipeline.logs import OVER_BUDGET, Loss
from pipeline.recording import MISREAD, POSE_FINDINGS, Finding, Given, extract_tables
from pipeline.recording.log_setup import LogSetup
from pipeline.run import Alignment, MotionError, read_alignment, read_wheels
from pipeline.sources import Vehicle, describe_types
from pipeline.stages import align_tables, checks, slip_stage, velocity
from pipeline.store import (
    JSON,
    CheckedTable,
    Generation,
    Manifest,
    TableEntry,
    check_table,
    hash_json,
    stored_contexts,
    stored_keys,
)
from pipeline.words import format_finding
from schemas import contract_of, tabulate


def hash_model(path: Path | None) -> str | None:
    """Hash of a model file's bytes and of the user's own Python of its effects; None without a model.

    Raises:
        MotionError: the file cannot be read, or the model file is wrong.
    """
    if path is None:
        return None
    hint = "Check the path; `slip model new` makes one."
    with naming_os_errors(
        MotionError, "model_not_found", "the model file cannot be read", where=path, hint=hint
    ):
        content = read_bounded(path)
    from pipeline.models import is_own, read_model  # noqa: PLC0415 - heavy

    own = {inspect.getfile(type(effect)) for effect in read_model(path).model if is_own(type(effect))}
    return hashlib.sha256(
        b"".join([content, *(read_bounded(Path(file)) for file in sorted(own))])
    ).hexdigest()


# Stages of one run: each reads the tables of the previous one and writes its own.
#
# A stage whose key has not changed is not computed: its tables and findings are reused.

Progress = Callable[[str], None]


@dataclass(frozen=True)
class StageOutcome:
    """Results of a stage besides its tables: findings, and facts for the summary."""

    findings: tuple[Finding, ...]
    context: Mapping[str, JSON] = field(default_factory=dict)


@dataclass
class Work:
    """One run's stages in progress.

    Attributes:
        run: name of the run.
        setup: the log and its configuration.
        options: options of the user.
        generation: generation that the tables are written to.
        keys: key of every stage.
        sha256: hash of the log.
        progress: callback, called with the current step.
    """

    run: str
    setup: LogSetup
    options: Options
    generation: Generation
    keys: Mapping[str, str]
    sha256: str
    progress: Progress
    contexts: dict[str, Mapping[str, JSON]] = field(default_factory=dict)
    findings: list[pl.DataFrame] = field(default_factory=list)
    computed: list[str] = field(default_factory=list)

    @property
    def alignment(self) -> Alignment:
        """Corrections of the run, available after the stage `extract`."""
        return read_alignment(self.generation.read_table("alignments"))

    @property
    def vehicle(self) -> Vehicle:
        """The vehicle; after the stage `extract` with the track multiplier estimated from the run."""
        if "alignments" not in self.generation.table_names:
            return self.setup.vehicle
        multiplier = self.alignment.track_multiplier
        return msgspec.structs.replace(self.setup.vehicle, controller_track_multiplier=multiplier)

    def run_stages(self) -> None:
        """Run every stage up to the last requested one, reusing results that have not changed."""
        stages: Mapping[str, Callable[[], StageOutcome]] = {
            "extract": self._extract,
            "velocity": self._velocity,
            "slip": self._slip,
            "aggregate": self._aggregate,
        }
        before = self.generation.previous
        done = stored_keys(before)
        for stage in STAGES[: STAGES.index(self.options.through) + 1]:
            if before is not None and done.get(stage) == self.keys[stage] and not self.options.force:
                self._take_over(stage, before)
                continue
            self.progress(stage)
            outcome = stages[stage]()
            self.contexts[stage] = outcome.context
            self.computed.append(stage)
            self._keep_findings(stage, outcome.findings)
            return_freed_memory()
        self.write("findings", pl.concat(self.findings))

    def _take_over(self, stage: str, before: Manifest) -> None:
        for table in TABLES[stage]:
            if table in before.tables:
                self.generation.reuse_table(table)
        self.contexts[stage] = stored_contexts(before).get(stage, {})
        self.findings.append(before.read("findings").filter(pl.col("stage") == stage))

    def _keep_findings(self, stage: str, findings: tuple[Finding, ...]) -> None:
        rows = [
            {
                "stage": stage, "id": one.id, "severity": one.severity, "where": one.where,
                "values": json.dumps(round_numbers(one.values, None)), "text": format_finding(one),
                "t_start": one.t_start, "t_end": one.t_end, "value": one.value, "count": one.count,
            }
            for one in findings
        ]  # fmt: skip
        self.findings.append(self._identify("findings", tabulate("findings", rows)))

    def write(self, table: str, frame: pl.DataFrame) -> TableEntry:
        """Write a table of this run, with the columns that identify the run, and the facts it declares."""
        facts: dict[str, float] = {}
        if wanted := contract_of(table).facts:
            length = self.setup.configuration.slip.length_scale_m
            known = {"length_scale_m": length, **msgspec.structs.asdict(self.vehicle)}
            facts = {name: known[name] for name in wanted if known[name] is not None}
        return self.generation.write_table(table, self._identify(table, frame), facts)

    def _identify(self, table: str, frame: pl.DataFrame) -> pl.DataFrame:
        """A table with the columns of its contract that say which run it is of."""
        setup = self.setup
        who = {
            "run": self.run,
            "dataset": setup.dataset,
            "vehicle": setup.vehicle.id,
            "terrain": setup.terrain,
        }
        labelled = frame.with_columns(pl.lit(text).alias(name) for name, text in who.items())
        return labelled.select(contract_of(table).schema.column_names())

    def _read(self, table: str) -> pl.DataFrame:
        """A table of an earlier stage; an empty frame if the log has no data for it."""
        if table in self.generation.table_names:
            return self.generation.read_table(table)
        return pl.DataFrame()

    def _extract(self) -> StageOutcome:
        setup = self.setup
        log = setup.choice.take_log()
        made = extract_tables(Given(log, setup.sources, setup.configuration, setup.vehicle, str(setup.path)))
        # Columns and tables are large: drop the references as early as possible.
        data = replace(log.data, topics=())
        del log
        self.setup = replace(setup, choice=replace(setup.choice, log=None))
        extracted = {
            name: check_table(name, self._identify(name, as_recorded(name, frame)))
            for name, frame in made.tables.items()
            if not frame.is_empty()
        }
        aligned = self._align(extracted)
        reports = {name: checked.report for name, checked in extracted.items()}
        broken = {name: report for name, report in reports.items() if report.quarantined}
        # Of poses the stage itself tells which they are.
        counted = {"poses": sum(one.count or 0 for one in made.findings if one.id in POSE_FINDINGS)}
        excluded = [
            Finding(
                "quarantined_rows",
                "warning",
                name,
                {"count": report.quarantined, "rules": sorted(report.rules)},
            )
            for name, report in broken.items()
            if report.quarantined != counted.get(name)
        ]
        notes = [Finding("log_note", "info", "log", {"note": note}) for note in data.notes]
        notes += [Finding("log_unchecked", "info", "log", {"why": data.unchecked})] if data.unchecked else []
        notes += [
            Finding("repeated_messages", "warning", topic, {"kind": "removed", "count": count})
            for topic, count in data.repeated.items()
        ]
        held = made.tables["poses"]["held"] if not made.tables["poses"].is_empty() else pl.Series([0])
        context: dict[str, JSON] = {
            "start_ns": made.start_ns,
            "paused_s": round(made.paused_s, 6),
            "clocks": {topic: dict(clock) for topic, clock in made.clocks.items()},
            "held_poses": round(float(held.mean() or 0.0), 6),  # type: ignore[arg-type]
            "quarantined": {
                name: {"rows": report.quarantined, "rules": dict(report.rules)}
                for name, report in broken.items()
            },
            "fetched_bytes": data.fetched_bytes or None,
            "losses": [summarize_loss(loss, data.index.start_ns) for loss in data.losses],
            "unchecked": data.unchecked or None,
            **aligned.context,
        }
        findings = (*setup.choice.findings, *made.findings, *excluded, *notes, *aligned.findings)
        return StageOutcome(findings, context)

    def _align(self, extracted: Mapping[str, CheckedTable]) -> StageOutcome:
        """Correct the extracted tables, and write them."""
        made = align_tables(
            {name: checked.valid for name, checked in extracted.items()},
            self.setup.vehicle,
            self.setup.alignment,
            body_commanded=self.setup.is_body_commanded,
            where=str(self.setup.path),
            is_drive_alone=self.setup.is_drive_alone,
            has_gyro_sign=self.setup.configuration.imu.sign is not None,
        )
        for name, checked in extracted.items():
            aligned = self._identify(name, made.tables.get(name, checked.valid))
            self.generation.write_checked(replace(checked, valid=aligned))
        self.write("alignments", made.tables["alignments"])
        fit = made.alignment.gyro
        gyro = None if fit is None else {
            "usable": True,
            "sign": -1 if fit.signed_scale < 0.0 else 1,
            "scale": round(abs(fit.signed_scale), 6),
            "bias_radps": round(fit.bias, 6),
            "pose_delay_s": round(made.alignment.heading_delay_s, 4),
            "residual": round(fit.residual, 4),
        }  # fmt: skip
        return StageOutcome(made.findings, {"gyro": gyro})

    def _velocity(self) -> StageOutcome:
        made = velocity.compute_velocities(
            self._read("poses"),
            self._read("imu"),
            self.alignment,
            self.setup.configuration.velocity,
            where=str(self.setup.path),
            wheels=read_wheels(self._read("wheels"), self.vehicle),
        )
        self.write("velocities", made.table)
        return StageOutcome(made.findings)

    def _slip(self) -> StageOutcome:
        setup, vehicle, velocities = self.setup, self.vehicle, self._read("velocities")
        tables = {name: self._read(name) for name in ("poses", "commands", "wheels", "imu")}
        made = slip_stage.compute_slip(
            velocities,
            tables,
            vehicle=vehicle,
            configuration=setup.configuration,
            hold_s=self.alignment.hold_s,
            inputs=self.options.inputs,
            where=str(setup.path),
            is_drive_alone=setup.is_drive_alone,
        )
        table, findings = self._set_against_model(made.slip)
        self.write("slip", table)
        self.write("windows", made.windows)
        self.write("events", made.events)
        checked: Sequence[Finding] = ()
        # Of signals that run.toml reads wrongly, nothing else is said.
        if not any(one.id in MISREAD for one in setup.choice.findings):
            checked = checks.check_run(
                velocities,
                tables,
                made,
                vehicle,
                command=setup.sources.command,
                is_drive_alone=setup.is_drive_alone,
            )
        model = None if self.options.model is None else self.options.model.name
        return StageOutcome((*made.findings, *findings, *checked), {"model": model})

    def _set_against_model(self, table: pl.DataFrame) -> tuple[pl.DataFrame, tuple[Finding, ...]]:
        """Add the velocity of the given model to table `slip`; without a model it stays unchanged."""
        path = self.options.model
        if path is None:
            return table, ()
        from pipeline.models import read_model  # noqa: PLC0415 - heavy

        read = {name: self._read(name) for name in TABLES["extract"]}
        return add_model(
            table,
            {name: frame for name, frame in read.items() if not frame.is_empty()},
            read_model(path),
            self.vehicle,
            length=self.setup.configuration.slip.length_scale_m,
            where=str(path),
        )

    def _aggregate(self) -> StageOutcome:
        ids = {name for findings in self.findings for name in findings["id"]}
        made = slip_stage.aggregate_run(
            self._read("slip"),
            self._read("windows"),
            self._read("velocities"),
            vehicle=self.vehicle,
            length=self.setup.configuration.slip.length_scale_m,
            moves="not_moving" not in ids,
        )
        self.write("aggregates", made)
        return StageOutcome(())


def as_recorded(table: str, frame: pl.DataFrame) -> pl.DataFrame:
    """An extracted table before alignment, with neutral corrections."""
    if table == "poses":
        return frame.with_columns(pl.lit(0.0).alias("latency"), pl.lit(value=False).alias("outlier"))
    names = ["left", "right", "sideways", "speed", *(["steering"] if table == "wheels" else [])]
    if table == "commands":
        frame = frame.with_columns(pl.lit(value=True).alias("followed"))
    if table == "wheels":
        frame = frame.with_columns(pl.lit(0.0).alias("latency"))
    if table in {"wheels", "commands"}:
        return frame.with_columns(
            pl.col(name).alias(f"{name}_aligned") for name in names if name in frame.columns
        )
    return frame


def summarize_loss(loss: Loss, start_ns: int) -> dict[str, JSON]:
    """A loss as JSON, its times in seconds since the log's start."""

    def since(stamp: int | None) -> float | None:
        return None if stamp is None else round((stamp - start_ns) / 1e9, 6)

    return {
        **pick(loss, "kind", "bytes", "chunks"),
        "start_s": since(loss.start_ns),
        "end_s": since(loss.end_ns),
        "text": loss.text,
    }


# Keys of stages: a stage is up to date if its key equals that of the existing results.
#
# A key is a hash of the previous stage's key, of the stage's own configuration and of the stage's version.
# The version must be incremented with every change of what the stage computes.

VERSIONS: Mapping[str, int] = {"extract": 25, "velocity": 7, "slip": 25, "aggregate": 5}


EXTRACTED = ("commands", "wheels", "poses", "imu")


TABLES: Mapping[str, tuple[str, ...]] = {
    "extract": (*EXTRACTED, "alignments"),
    "velocity": ("velocities",),
    "slip": ("slip", "windows", "events"),
    "aggregate": ("aggregates",),
}


def key_stages(
    run: str, sha256: str, setup: LogSetup, inputs: tuple[str, ...], model: str | None = None
) -> dict[str, str]:
    """Key of every stage of a run, in order; ``model`` is the hash of the model for the residual slip."""
    plain = msgspec.to_builtins(setup.configuration)
    pose_limits = {name: plain["velocity"][name] for name in ("jump_m", "jump_rad", "gap_s")}
    own = {
        "extract": {
            "log": sha256,
            "run": [run, setup.dataset, setup.terrain],
            "vehicle": msgspec.to_builtins(setup.vehicle),
            # All that no later stage has to itself: a new section is forgotten by none.
            "configuration": {name: part for name, part in plain.items() if name not in {"velocity", "slip"}},
            "limits": pose_limits,
            "message_types": describe_types(one.type_name for one in setup.index.channels),
        },
        "velocity": plain["velocity"],
        "slip": {"slip": plain["slip"], "inputs": inputs, "model": model},
        "aggregate": {},
    }
    # A file that is found beside the log later is told all the same.
    if files := [one.values["why"] for one in setup.choice.findings if one.id == "file_not_read"]:
        own["extract"]["files_not_read"] = files
    # A higher limit reads more of the log.
    unread = [loss.text for loss in setup.index.losses if loss.kind == OVER_BUDGET]
    if unread:
        own["extract"]["left_out"] = unread
    # The losses of a bag are known only after reading it.
    catalogs = [part.catalog for part in setup.index.parts]
    allowed = [catalog.most_inflated for catalog in catalogs if catalog.most_inflated is not None]
    if allowed:
        own["extract"]["max_inflated"] = allowed
    keys: dict[str, str] = {}
    above = ""
    for stage in STAGES:
        contracts = {table: contract_of(table).version for table in (*TABLES[stage], "findings")}
        above = hash_json([above, stage, VERSIONS[stage], own[stage], contracts])
        keys[stage] = above
    return keys
