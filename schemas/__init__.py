"""The contract of every table: columns, types, units, frames and rules.

A table is a subclass of `Table` with a ``VERSION``, called as the class; it is found by being in this
folder. Tables over many runs stand in this file. Units and frames stand in the columns' metadata and reach
the Parquet files from there.
"""

import functools
import importlib
import pkgutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import dataframely as dy
import polars as pl

LARGEST_NS = 2**62


def source(description: str = "input u: the command or the measured wheels") -> dy.Enum:
    """Which input a row speaks of."""
    return choice(("command", "measured"), description)


def choice(words: Sequence[str], description: str) -> dy.Enum:
    """One of some words, never null."""
    return dy.Enum(words, metadata={"description": description})


def count(description: str, least: int = 0, *, nullable: bool = False) -> dy.Int64:
    """A whole number."""
    return dy.Int64(min=least, nullable=nullable, metadata={"description": description})


def name(description: str) -> dy.String:
    """A text that is never empty."""
    return dy.String(min_length=1, metadata={"description": description})


def stamp(frame: str = "log clock", description: str = "stamp of the sample") -> dy.Int64:
    """Time stamp, in the clock of the log if no other is said."""
    metadata = {"unit": "ns", "frame": frame, "description": description}
    return dy.Int64(min=-LARGEST_NS, max=LARGEST_NS, metadata=metadata)


def log_time() -> dy.Int64:
    """When the recorder wrote the message."""
    return stamp("recorder clock", "log time of the message")


def seconds(description: str = "time since the run's first sample") -> dy.Float64:
    """Seconds since the start of the run."""
    return number("s", description, frame="log clock")


def number(unit: str, description: str, *, frame: str = "", nullable: bool = False) -> dy.Float64:
    """A finite number with a unit; null only where ``nullable`` says so."""
    metadata = {"unit": unit, "description": description}
    if frame:
        metadata["frame"] = frame
    return dy.Float64(nullable=nullable, check=lambda value: value.is_finite(), metadata=metadata)


optional = partial(number, nullable=True)
"""A finite number with a unit, or null."""


def vector(unit: str, description: str, frame: str, size: int = 3) -> Iterator[dy.Float64]:
    """The components of a vector in a frame."""
    return (number(unit, description, frame=frame) for _ in range(size))


def bounded(
    unit: str,
    description: str,
    low: float | None = None,
    high: float | None = None,
    *,
    nullable: bool = False,
) -> dy.Float64:
    """A number with a unit within what can be; one without bounds may be anything."""
    metadata = {"unit": unit, "description": description}
    return dy.Float64(nullable=nullable, min=low, max=high, metadata=metadata)


def body(unit: str, description: str, *, nullable: bool = False) -> dy.Float64:
    """A finite number in the body frame (x forward, y left, z up; REP-103)."""
    return number(unit, description, frame="base_link", nullable=nullable)


def text(description: str) -> dy.String:
    """A text that is always there, possibly empty."""
    return dy.String(metadata={"description": description})


def flag(description: str) -> dy.Bool:
    """Yes or no, never null."""
    return dy.Bool(metadata={"description": description})


def segment() -> dy.Int32:
    """Stretch without gap, clock jump or pose jump."""
    return dy.Int32(min=0, metadata={"description": "number of the segment; nothing crosses its ends"})


def step() -> dy.Int32:
    """Stretch of one command."""
    return dy.Int32(min=0, metadata={"description": "number of the command step within the run"})


def drive_is_complete() -> pl.Expr:
    """Either both wheel speeds or speed and steering angle are there."""
    wheels = pl.col("left").is_not_null() & pl.col("right").is_not_null()
    return wheels | (pl.col("speed").is_not_null() & pl.col("steering").is_not_null())


class Table(dy.Schema):
    """Columns that every table has: which run a row belongs to.

    The table is called as the class, in small letters. ``FACTS`` names numbers of the whole table, which
    stand in the metadata of its file.
    """

    VERSION: ClassVar[int]
    FACTS: ClassVar[Mapping[str, str]] = {}

    run = dy.String(metadata={"description": "run the row belongs to"})
    dataset = dy.String(metadata={"description": "runs of one vehicle on one terrain"})
    vehicle = dy.String(metadata={"description": "vehicle name"})
    terrain = dy.String(metadata={"description": "terrain name, `unknown` where none was given"})


@dataclass(frozen=True)
class Contract:
    """A table's contract as the store needs it.

    Attributes:
        name: table name, a plural noun; the file is ``<name>.parquet``.
        version: raised whenever a column or a rule changes its meaning.
        schema: the dataframely schema with columns and rules.
    """

    name: str
    version: int
    schema: type[Table]

    @property
    def facts(self) -> Mapping[str, str]:
        """Numbers of the whole table in its file's metadata, described; their names end in the unit."""
        return self.schema.FACTS

    def metadata_of(self, column: str) -> dict[str, str]:
        """Unit, frame and description of a column; absent ones are left out."""
        metadata: dict[str, Any] = self.schema.columns()[column].metadata or {}
        return {key: str(value) for key, value in metadata.items()}


@functools.cache
def list_contracts() -> tuple[Contract, ...]:
    """All contracts of this folder, sorted by name."""
    names = (
        "schemas",
        *(f"schemas.{module.name}" for module in pkgutil.iter_modules([str(Path(__file__).parent)])),
    )
    contracts = [
        Contract(table.__name__.lower(), table.VERSION, table)
        for name in names
        for table in vars(importlib.import_module(name)).values()
        if isinstance(table, type) and issubclass(table, Table) and "VERSION" in vars(table)
    ]
    return tuple(sorted(contracts, key=lambda contract: contract.name))


def contract_of(name: str) -> Contract:
    """The contract of a table.

    Raises:
        KeyError: there is no such table; the message lists those there are.
    """
    for contract in list_contracts():
        if contract.name == name:
            return contract
    known = ", ".join(contract.name for contract in list_contracts())
    raise KeyError(f"no table is called {name!r}; there are: {known}")


def tabulate(table: str, rows: Iterable[Mapping[str, object]]) -> pl.DataFrame:
    """Rows as a table, without the columns that every table has; missing values are null."""
    kinds = contract_of(table).schema.create_empty().schema
    own = {name: kind for name, kind in kinds.items() if name not in Table.column_names()}
    return pl.DataFrame(list(rows), schema=own, orient="row")


class Datasets(Table):
    """One row a dataset and input; ``run`` is `*`, ``keys`` names the runs.

    Runs are the unit: a number of a dataset is the median over its runs, however long they are. Columns that
    `slip compare` alone works out are null until it has run.
    """

    VERSION: ClassVar[int] = 4

    by = text("columns that define a dataset, for example `dataset` or `vehicle,terrain`")
    input = source()
    runs = count("number of runs", 1)
    samples = count("time steps of all runs")
    windows = count("2 s windows of all runs", nullable=True)
    distance = optional("m", "distance driven in the samples of all runs")
    duration = optional("s", "time of the samples of all runs")
    length_scale = optional("m", "L that turns yaw rate into speed in the slip modulus")
    median_modulus = optional("m/s", "median over runs of the runs' median slip modulus")
    low = optional("m/s", "lower end of the 95 % interval of the typical median slip modulus")
    high = optional("m/s", "upper end of it")
    interval = text("of what: over runs; one run, with the spread of others; this run only; or empty")
    equal_modulus = optional("m/s", "slip modulus at equal driving: mean of logarithms, weighed by run")
    equal_low = optional("m/s", "lower end of its 95 % interval over runs")
    equal_high = optional("m/s", "upper end of it")
    median_window_norm = optional("m/s", "median over runs of the runs' median window norm")
    norm_low = optional("m/s", "lower end of the 95 % interval of the typical window norm")
    norm_high = optional("m/s", "upper end of it")
    published_norm = optional("m/s", "median window norm of the published chain")
    transitory_median_modulus = optional("m/s", "after a change of command")
    steady_median_modulus = optional("m/s", "away from changes of command")
    drivetrain_mean_square = optional("m^2/s^2", "of f(command) - f(measured wheels)")
    ground_mean_square = optional("m^2/s^2", "of f(measured wheels) - v")
    cross_mean_square = optional("m^2/s^2", "twice the mean product of the two parts")
    height_rate = optional("m/s", "height variation per second")
    largest_kinetic_energy = optional("J", "largest 1/2 m v^2 of any run")
    relative_slip = optional("1", "median slip modulus over ideal speed, while it moves")
    slip_energy = optional("J", "median of 1/2 m |g_xy|^2 + 1/2 I g_w^2")
    lost_energy = optional("1", "slip path over path driven: energy lost per metre and mass, over mu g")
    unpredictability = optional("m/s", "held-out RMS residual of a fitted slip model")
    relative_unpredictability = optional("1", "unpredictability over RMS ideal speed")
    transitory_slip = optional("m", "slip path a change of command adds to the steady one")
    keys = text("run/generation of every run counted, separated by spaces")


UNITS = ("runs", "blocks")


class Comparisons(Table):
    """One row a pair, input and quantity; ``run``, ``vehicle`` and ``terrain`` are `*`.

    ``dataset`` names both sides. Numbers that a pair does not have are null, and its note says why.
    """

    VERSION: ClassVar[int] = 2

    by = text("columns that define a dataset")
    input = source()
    quantity = text(
        "what is compared: median_modulus as driven, equal_modulus at equal driving, or published_norm"
    )
    a = text("one dataset")
    b = text("the other")
    runs_a = count("runs of a", 1)
    runs_b = count("runs of b", 1)
    ratio = optional("1", "geometric mean of the runs of b over that of a, weighed where they are")
    ratio_low = optional("1", "lower end of its 95 % interval")
    ratio_high = optional("1", "upper end of it")
    shift = optional("m/s", "Hodges-Lehmann shift b - a of the units")
    low = optional("m/s", "lower end of its 95 % interval")
    high = optional("m/s", "upper end of it")
    cliffs_delta = bounded("1", "Cliff's delta of the units; above 0: b is larger", -1.0, 1.0, nullable=True)
    size = text("Cliff's delta in a word")
    p = bounded("1", "two-sided p of this pair alone", 0.0, 1.0, nullable=True)
    p_adjusted = bounded("1", "p over the family of pairs", 0.0, 1.0, nullable=True)
    smallest_p = bounded("1", "smallest corrected p that the counts allow", 0.0, 1.0, nullable=True)
    method = text("test and correction")
    unit_of_analysis = choice(UNITS, "the unit of the test: runs, or blocks of single runs")
    spread = optional("1", "standard deviation of the logarithm between runs, pooled over datasets")
    freedom = count("degrees of freedom of the spread", nullable=True)
    bins = count("cells of commanded speed and yaw rate that both drove", nullable=True)
    overlap = bounded("1", "share of the samples in them, of the side with less", 0.0, 1.0, nullable=True)
    p_uncorrected = bounded(
        "1",
        "plain Mann-Whitney of all samples: not valid, they are correlated",
        0.0,
        1.0,
        nullable=True,
    )
    note = text("remarks on the row; may be empty")
    keys = text("run/generation of every run counted, separated by spaces")


LEVELS = ("vehicle", "terrain", "run", "open")


class Fleet(Table):
    """One row a vehicle and number, ``terrain`` `*`, then one for each terrain.

    ``run`` and ``dataset`` are `*`; ``keys`` names the runs.
    """

    VERSION: ClassVar[int] = 2

    effect = name("id of the effect")
    parameter = name("name of the parameter")
    unit = text("unit of value, low, high and the spreads")
    level = choice(
        LEVELS, "level of the number: vehicle, terrain or run; open where the runs do not determine it"
    )
    name = text("what the effect is called at that level; all candidates where it is open")
    because = text("why that level, or which runs would determine it")
    value = number("1", "common value of the vehicle, or mean of the terrain, in the column `unit`")
    low = optional("1", "lower end of its 95 % interval")
    high = optional("1", "upper end of it")
    spread_terrain = optional("1", "standard deviation between terrains")
    spread_run = optional("1", "standard deviation between runs of a terrain")
    another_low = optional(
        "1", "lower end of the 95 % band of another run: on another terrain, or on this one"
    )
    another_high = optional("1", "upper end of it")
    runs = count("runs behind the value", 1)
    named = count("runs whose diagnosis names the effect", nullable=True)
    keys = text("run/generation of every run counted, separated by spaces")


_NAME = r"^[^\x00-\x1f\x7f/\\]{1,120}$"


def _text(pattern: str, description: str, *, nullable: bool = False) -> dy.String:
    """A text that looks like this."""
    return dy.String(nullable=nullable, regex=pattern, metadata={"description": description})


def _feature(
    unit: str, description: str, low: float = 0.0, high: float = 1e9, *, nullable: bool = True
) -> dy.Float64:
    """A number within what can be."""
    return dy.Float64(
        nullable=nullable,
        min=low,
        max=high,
        check=lambda value: value.is_finite(),
        metadata={"unit": unit, "description": description},
    )


class Features(Table):
    """One row a run and input; ``run`` is the beginning of the log's hash: no name of a file is shared."""

    VERSION: ClassVar[int] = 1

    run = _text(r"^[0-9a-f]{16}$", "first 16 digits of sha256")
    dataset = _text(_NAME, "runs of one vehicle on one terrain")
    vehicle = _text(_NAME, "vehicle name")
    terrain = _text(_NAME, "terrain name")
    input = _text("^(command|measured)$", "input u: command or measured wheels")
    sha256 = _text(r"^[0-9a-f]{64}$", "SHA-256 of the log, which counts once")
    month = _text(r"^(19|20)\d\d-(0[1-9]|1[0-2])$", "month of the run", nullable=True)
    made_by = _text(r"^[0-9A-Za-z.+_-]{1,40}$", "version of slip")
    from_results = _text(r"^[0-9A-Za-z_-]{1,80}$", "key of the results: inputs and versions")
    mass = _feature("kg", "mass as configured", 0.01, 1e6)
    inertia = _feature("kg m^2", "yaw inertia of a plate of that mass, as wide as the track", 0.0, 1e8)
    length_scale = _feature("m", "L that turns yaw rate into speed in the slip modulus", 1e-3, 100.0)
    samples = dy.Int64(min=1, max=10**10, metadata={"description": "time steps"})
    windows = dy.Int64(min=0, max=10**9, nullable=True, metadata={"description": "2 s windows"})
    distance = _feature("m", "distance driven in the samples")
    duration = _feature("s", "time of the samples")
    median_modulus = _feature("m/s", "median slip modulus", 0.0, 1e3, nullable=False)
    median_window_norm = _feature("m/s", "median norm of 2 s windows", 0.0, 1e4)
    transitory_median_modulus = _feature("m/s", "after a change of command", 0.0, 1e3)
    steady_median_modulus = _feature("m/s", "away from changes of command", 0.0, 1e3)
    drivetrain_mean_square = _feature("m^2/s^2", "of f(command) - f(measured wheels)", 0.0, 1e6)
    ground_mean_square = _feature("m^2/s^2", "of f(measured wheels) - v", 0.0, 1e6)
    cross_mean_square = _feature("m^2/s^2", "twice the mean product of the two parts", -1e6, 1e6)
    height_rate = _feature("m/s", "height variation per second", 0.0, 1e3)
    largest_kinetic_energy = _feature("J", "largest 1/2 m v^2", 0.0, 1e10)
    relative_slip = _feature("1", "median slip modulus over ideal speed, while it moves", 0.0, 1e6)
    slip_energy = _feature("J", "median of 1/2 m |g_xy|^2 + 1/2 I g_w^2", 0.0, 1e12)
    lost_energy = _feature("1", "slip path over path driven: energy per metre and mass over mu g", 0.0, 1e9)
    unpredictability = _feature("m/s", "held-out RMS residual of a fitted slip model", 0.0, 1e3)
    relative_unpredictability = _feature("1", "unpredictability over RMS ideal speed", 0.0, 1e6)
    transitory_slip = _feature("m", "slip path a change of command adds to the steady one", -1e6, 1e6)

    @dy.rule()
    def run_is_the_beginning_of_the_hash(cls) -> pl.Expr:  # noqa: N805 - rules receive the class
        return pl.col("sha256").str.slice(0, 16) == pl.col("run")


STATUSES = (
    "read", "vendor", "second-hand", "inferred", "measured", "assumed", "estimated", "placeholder",
    "unconfirmed",
)  # fmt: skip
BOUNDS = ("value", "upper", "lower", "uncertain")
DRIVES = ("skid-steer", "tracked", "ackermann", "other")
MODELS = ("kinematic", "dynamic", "learned", "dataset", "several")
FEATURES = {
    "vehicle": "vehicle",
    "model": "model",
    "terrain": "terrain",
    "mass_kg": "mass",
    "speed_mps": "speed",
    "slope_score": "scores",
    "slope_deg": "slope",
    "height_variation_mps": "height_variation",
    "hardness": "hardness",
    "friction_low": "friction",
    "temperature_c": "temperature",
}
"""Which status column speaks of which value."""

_ENERGY_TOLERANCE = 0.02


def _deployment_text(description: str) -> dy.String:
    return dy.String(nullable=True, metadata={"description": description})


def _status(of: str) -> dy.Enum:
    return dy.Enum(STATUSES, nullable=True, metadata={"description": f"how well {of} is known"})


_number = partial(bounded, nullable=True)


class Deployments(dy.Schema):
    """One row a deployment; what is not known is empty, never guessed."""

    key = dy.String(
        primary_key=True, regex=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", metadata={"description": "unique short name"}
    )
    year = dy.Int64(min=1950, max=2100, metadata={"description": "year of publication, or of the drive"})
    authors = _deployment_text("authors, separated by semicolons")
    title = _deployment_text("title of the publication")
    venue = _deployment_text("where it was published, with DOI or arXiv number where there is one")
    citation_status = _status("the citation")
    vehicle = _deployment_text("vehicle")
    vehicle_status = _status("the vehicle")
    drive = choice(DRIVES, "how it steers")
    model_type = dy.Enum(MODELS, nullable=True, metadata={"description": "kind of motion model; the marker"})
    model = _deployment_text("the model in a few words")
    model_status = _status("the model")
    model_source = _deployment_text("where the model is described, if not in the publication")
    terrain = _deployment_text("the most complex terrain driven on")
    terrain_status = _status("the terrain")
    terrain_source = _deployment_text("where the terrain is described")
    surface = _deployment_text("state of the surface: wet, frozen, resurfaced, ...")
    mass_kg = _number("kg", "mass as driven", 0.01)
    mass_status = _status("the mass")
    mass_source = _deployment_text("where the mass is given")
    speed_mps = _number("m/s", "highest speed driven", 0.0)
    speed_status = _status("the speed")
    speed_source = _deployment_text("where the speed is given")
    kinetic_energy_j = _number("J", "1/2 mass speed^2", 0.0)
    kinetic_energy_bound = dy.Enum(
        BOUNDS, nullable=True, metadata={"description": "value, upper or lower bound, or uncertain"}
    )
    slope_score = _number("1", "slope: 0 below 2 deg, 1 to 5, 2 to 12, 3 to 20, 4 above", 0.0, 4.0)
    roughness_score = _number("1", "ISO 8608 class: 0 A-B, 1 C-D, 2 E-F, 3 G-H, 4 obstacles", 0.0, 4.0)
    sinkage_score = _number(
        "1", "sinkage / wheel radius: 0 rigid, 1 < 2 %, 2 to 10, 3 to 30, 4 above", 0.0, 4.0
    )
    friction_score = _number("1", "peak friction: 0 >= .7, 1 to .5, 2 to .35, 3 to .2, 4 below", 0.0, 4.0)
    scores_status = _status("the four scores")
    slope_deg = _number("deg", "steepest slope", -90.0, 90.0)
    slope_status = _status("the slope")
    height_variation_mps = _number("m/s", "median height variation per second (Triest et al. 2022)", 0.0)
    height_variation_status = _status("the height variation")
    hardness = _deployment_text("hardness of the ground, with its unit")
    hardness_status = _status("the hardness")
    friction_low = _number("1", "peak friction coefficient, from", 0.0, 2.0)
    friction_high = _number("1", "peak friction coefficient, to", 0.0, 2.0)
    friction_status = _status("the friction")
    temperature_c = _number("degC", "temperature of air or ground", -90.0, 90.0)
    temperature_status = _status("the temperature")
    remarks = _deployment_text("what must be known")

    @dy.rule()
    def every_value_has_a_status(cls) -> pl.Expr:  # noqa: N805 - dataframely rules receive the class
        return pl.all_horizontal(
            pl.col(value).is_null() | pl.col(f"{status}_status").is_not_null()
            for value, status in FEATURES.items()
        )

    @dy.rule()
    def kinetic_energy_is_that_of_mass_and_speed(cls) -> pl.Expr:  # noqa: N805
        energy = pl.col("kinetic_energy_j")
        own = 0.5 * pl.col("mass_kg") * pl.col("speed_mps") ** 2
        return energy.is_null() | ((energy - own).abs() <= _ENERGY_TOLERANCE * own).fill_null(value=False)

    @dy.rule()
    def kinetic_energy_has_its_bound(cls) -> pl.Expr:  # noqa: N805
        return pl.col("kinetic_energy_j").is_null() == pl.col("kinetic_energy_bound").is_null()

    @dy.rule()
    def scores_are_all_there_or_none(cls) -> pl.Expr:  # noqa: N805
        names = ("slope_score", "roughness_score", "sinkage_score", "friction_score")
        known = sum((pl.col(name).is_not_null().cast(pl.Int64) for name in names), pl.lit(0))
        return known.is_in([0, 4])
