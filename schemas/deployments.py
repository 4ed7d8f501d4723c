"""Deployments of the literature and of anybody: features of vehicle and terrain, with their status."""

from functools import partial

import dataframely as dy
import polars as pl

from schemas import fields

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


def _text(description: str) -> dy.String:
    return dy.String(nullable=True, metadata={"description": description})


def _status(of: str) -> dy.Enum:
    return dy.Enum(STATUSES, nullable=True, metadata={"description": f"how well {of} is known"})


_number = partial(fields.bounded, nullable=True)


class Deployments(dy.Schema):
    """One row a deployment; what is not known is empty, never guessed."""

    key = dy.String(
        primary_key=True, regex=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", metadata={"description": "unique short name"}
    )
    year = dy.Int64(min=1950, max=2100, metadata={"description": "year of publication, or of the drive"})
    authors = _text("authors, separated by semicolons")
    title = _text("title of the publication")
    venue = _text("where it was published, with DOI or arXiv number where there is one")
    citation_status = _status("the citation")
    vehicle = _text("vehicle")
    vehicle_status = _status("the vehicle")
    drive = fields.choice(DRIVES, "how it steers")
    model_type = dy.Enum(MODELS, nullable=True, metadata={"description": "kind of motion model; the marker"})
    model = _text("the model in a few words")
    model_status = _status("the model")
    model_source = _text("where the model is described, if not in the publication")
    terrain = _text("the most complex terrain driven on")
    terrain_status = _status("the terrain")
    terrain_source = _text("where the terrain is described")
    surface = _text("state of the surface: wet, frozen, resurfaced, ...")
    mass_kg = _number("kg", "mass as driven", 0.01)
    mass_status = _status("the mass")
    mass_source = _text("where the mass is given")
    speed_mps = _number("m/s", "highest speed driven", 0.0)
    speed_status = _status("the speed")
    speed_source = _text("where the speed is given")
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
    hardness = _text("hardness of the ground, with its unit")
    hardness_status = _status("the hardness")
    friction_low = _number("1", "peak friction coefficient, from", 0.0, 2.0)
    friction_high = _number("1", "peak friction coefficient, to", 0.0, 2.0)
    friction_status = _status("the friction")
    temperature_c = _number("degC", "temperature of air or ground", -90.0, 90.0)
    temperature_status = _status("the temperature")
    remarks = _text("what must be known")

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
    def kinetic_energy_says_what_it_is(cls) -> pl.Expr:  # noqa: N805
        return pl.col("kinetic_energy_j").is_null() == pl.col("kinetic_energy_bound").is_null()

    @dy.rule()
    def scores_are_all_there_or_none(cls) -> pl.Expr:  # noqa: N805
        names = ("slope_score", "roughness_score", "sinkage_score", "friction_score")
        known = sum((pl.col(name).is_not_null().cast(pl.Int64) for name in names), pl.lit(0))
        return known.is_in([0, 4])
