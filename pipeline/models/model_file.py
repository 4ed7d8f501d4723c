"""The model file: TOML that people read, diff and commit; every error states its line."""

import math
import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import msgspec
from msgspec.structs import replace

from pipeline.core import (
    SlipError,
    TomlError,
    enumerate_texts,
    number_in,
    parse_toml,
    read_bounded_text,
    round_digits,
    shorten,
)
from pipeline.models.catalogue import find_effect, refuse_taken
from pipeline.models.effect import Effect
from pipeline.models.formula import CHANNELS, FormulaEffect, make_parameter
from pipeline.models.model import Model
from pipeline.models.number import DOUBTS, UNDECIDED, Number, expect_another_run
from pipeline.models.parameter import Parameter, is_of_one_run
from pipeline.run import MotionError
from pipeline.sources import (
    ConfigurationError,
    Fault,
    StandIn,
    Vehicle,
    VehicleSection,
    convert_to,
    resolve_vehicle,
)

FORMAT = 1
"""Version of the format of model files; other versions are rejected."""
_SECTIONS = ("format", "vehicle", "effect", "fit", "note")
_NUMBER_KEYS = {"value", "low", "high", "unit", "bounds", "neutral", "fixed", "per_run", "doubt", "stretches"}
_ABOVE = "Write it in the first line: in TOML a line belongs to the table above it."
_ID = re.compile(r"[^\W\d][\w-]{0,63}")

Table = dict[str, object]

CONTRADICTED: Final = "in doubt: findings of the runs of the fit contradict it"
"""What is said of a dimension of the vehicle that is not to be used as it stands."""
_UNKNOWN = Number(math.nan)


class _VehicleTable(VehicleSection, frozen=True, kw_only=True):
    """``[vehicle]`` of a model file, which also says what is not known of the vehicle."""

    stand_ins: list[StandIn] | None = None


@dataclass(frozen=True)
class ModelFile:
    """A model and the other contents of its file.

    Attributes:
        model: vehicle and effects with their values.
        per_run: labels ``effect.name`` whose values are estimated per run.
        numbers: by label what the last fit found: intervals, and what its runs make doubtful. The values
            are those of the model, and `find_number` knows all doubts.
        fit: record of the last fit: input, runs with hashes, delays, ladder; empty before the first fit.
        note: free text.
    """

    model: Model
    per_run: tuple[str, ...] = ()
    numbers: Mapping[str, Number] = field(default_factory=dict)
    fit: Mapping[str, object] = field(default_factory=dict)
    note: str = ""

    @property
    def last_input(self) -> str | None:
        """Input of the last fit; None before the first fit."""
        source = self.fit.get("input")
        return source if isinstance(source, str) else None

    @property
    def undecided(self) -> list[list[str]]:
        """Groups of effects that explained the fitted runs equally well; the model contains one of each."""
        groups = self.fit.get("undecided")
        lists = [group for group in groups if isinstance(group, list)] if isinstance(groups, list) else []
        return [[str(name) for name in group] for group in lists]

    @property
    def contradicted(self) -> list[str]:
        """Dimensions of the vehicle that findings of the fitted runs contradict, and nobody changed since."""
        rows = self.fit.get("contradicted")
        values = rows if isinstance(rows, dict) else {}
        now = msgspec.structs.asdict(self.model.vehicle)
        return [name for name, one in values.items() if now.get(name) and round_digits(now[name]) == one]

    def list_rivals(self, effect: str) -> list[str]:
        """Ids of effects that explained the fitted runs as well as an effect of the model."""
        return [name for group in self.undecided if effect in group for name in group if name != effect]

    def find_number(self, effect: Effect, parameter: Parameter) -> Number:
        """A value with its interval and its gravest doubt: that it shows, of its effect, or of the runs.

        A value that is fixed is the user's own. In a fitted model another one is undetermined without an
        interval.
        """
        value, label = effect.values[parameter.name], f"{effect.id}.{parameter.name}"
        noted = replace(self.numbers.get(label, _UNKNOWN), value=value, unit=parameter.unit)
        if value == parameter.neutral or not math.isfinite(value) or parameter.name in effect.fixed:
            return replace(noted, doubt="", stretches=0)
        if self.list_rivals(effect.id):
            noted = replace(noted, doubt=UNDECIDED, stretches=0)
        alone = {*self.per_run, *(row.get("parameter") for row in self.list_fitted("own"))}
        ends = noted.low, noted.high
        if math.isnan(noted.low) and (
            not self.list_fitted("runs") or not alone.isdisjoint({label, effect.id})
        ):
            # Nobody fitted it, or each run has its own.
            ends = value, value
        number = replace(noted, low=ends[0], high=ends[1]).doubt_as(parameter)
        number = replace(number, low=noted.low, high=noted.high)
        if number.at_bound or is_of_one_run(effect.parameters):
            return number
        is_measured = parameter.between_runs is not None
        there = expect_another_run(parameter, number)
        return replace(number, another_run=there, is_spread_measured=is_measured)

    def list_numbers(self) -> dict[str, Number]:
        """All numbers of the model by label ``effect.name``; see `find_number`."""
        return {
            f"{effect.id}.{parameter.name}": self.find_number(effect, parameter)
            for effect in self.model
            for parameter in effect.parameters
        }

    def list_doubtful(self) -> dict[str, Number]:
        """The numbers that are in doubt, by label."""
        return {label: number for label, number in self.list_numbers().items() if number.doubt}

    def list_fitted(self, key: str) -> list[dict[str, object]]:
        """Tables of a name in the last fit, such as `runs` or `own`; empty before the first fit."""
        rows = self.fit.get(key)
        return [row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []

    def find_wheel_delay(self, run: str) -> float:
        """Delay of the encoders of a run in the last fit [s]; zero for a run that was not part of it."""
        delays = (row.get("wheel_delay_s") for row in self.list_fitted("runs") if row.get("run") == run)
        return next((late for late in delays if isinstance(late, float)), 0.0)

    def list_own(self) -> dict[str, dict[str, Number]]:
        """Numbers that runs of the last fit have of their own: by label, then by run."""
        own: dict[str, dict[str, Number]] = {}
        for row in self.list_fitted("own"):
            label, value = str(row.get("parameter")), number_in(row, "value")
            effect, _, name = label.partition(".")
            if value is None or effect not in self.model:
                continue
            parameter = self.model.effect(effect).parameter(name)
            low, high = (number_in(row, end) for end in ("low", "high"))
            ends = (math.nan, math.nan) if low is None or high is None else (low, high)
            own.setdefault(label, {})[str(row.get("run"))] = Number(value, *ends).doubt_as(parameter)
        return own

    def find_effects(self, run: str) -> tuple[Effect, ...]:
        """The effects with the values estimated for one run in the last fit."""
        own = {label: one[run].value for label, one in self.list_own().items() if run in one}
        return tuple(
            effect.change(**{n: own[label] for n in effect.values if (label := f"{effect.id}.{n}") in own})
            for effect in self.model
        )


def read_model(path: Path) -> ModelFile:
    """Read a model file.

    Raises:
        MotionError: the file is missing, is not TOML or is not valid, or has an effect of the user's own that
            is not loaded (`load_effects`); with the line.
    """
    return parse_model(read_text(path), path)


def read_text(path: Path) -> str:
    """Text of a model file.

    Raises:
        MotionError: the file is missing or cannot be read.
    """
    try:
        return read_bounded_text(path)
    except FileNotFoundError:
        what = "there is no such model file"
        hint = f"Make one: slip model new {path.name} --vehicle husky_a200."
        raise MotionError("model_not_found", what, where=str(path), hint=hint) from None
    except (UnicodeDecodeError, IsADirectoryError) as error:
        is_folder = isinstance(error, IsADirectoryError)
        what = f"this is not a model file: it is {'a folder' if is_folder else 'not text'}"
        hint = "Give the TOML file that `slip diagnose --apply` or `slip model new` wrote."
        raise MotionError("model_unreadable", what, where=str(path), hint=hint) from None
    except OSError as error:
        raise MotionError(
            "model_unreadable",
            f"cannot be read: {error.strerror or error}",
            where=str(path),
            hint="Check the file.",
        ) from None


def parse_model(text: str, path: Path) -> ModelFile:
    """Parse the text of a model file; see `read_model`.

    Args:
        text: TOML.
        path: path of the file, for errors.
    """
    return _Reader(text, path).read()


class _Reader:
    """One file: its text for line numbers, its tables, and the parsed contents so far."""

    def __init__(self, text: str, path: Path) -> None:
        self.lines = text.splitlines()
        self.path = path
        try:
            self.tree: Table = parse_toml(text)
        except TomlError as error:
            where = path if error.line is None else f"{path}:{error.line}"
            raise MotionError(
                "model_not_toml", error.what, where=str(where), hint="Correct that line."
            ) from None
        self.per_run: list[str] = []
        self.numbers: dict[str, Number] = {}

    def read(self) -> ModelFile:
        """Parse the whole file."""
        for key in self.tree:
            if key not in _SECTIONS:
                known = f"Known are: {', '.join(_SECTIONS)}."
                raise self._error(f"unknown key {key!r}", known, None, key, code="unknown_key")
        if self.tree.get("format", FORMAT) != FORMAT:
            what, hint = (
                f"format {self.tree['format']!r} is not known",
                f"This version reads format {FORMAT}.",
            )
            raise self._error(what, hint, None, "format", code="model_too_new")
        vehicle = self._vehicle()
        fit = self.tree.get("fit", {})
        return ModelFile(
            model=Model(vehicle, tuple(self._list_effects(vehicle))),
            per_run=tuple(self.per_run),
            numbers=self.numbers,
            fit=fit if isinstance(fit, dict) else {},
            note=str(self.tree.get("note", "")),
        )

    def _list_effects(self, vehicle: Vehicle) -> list[Effect]:
        tables = self.tree.get("effect", [])
        if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
            raise self._error("effects are written as [[effect]]", "Double the brackets.", None, "effect")
        effects: list[Effect] = []
        for number, table in enumerate(tables):
            effects.append(self._effect(number, table))
            try:
                Model(vehicle, tuple(effects))
            except MotionError as error:
                raise self._repeat(error, ("effect", number), "id") from error
            self._require_number(("effect", number), table, effects[-1])
        return effects

    def _require_number(self, at: tuple[str, int], table: Table, effect: Effect) -> None:
        """Refuse an effect without any of its numbers, which would change nothing."""
        names = [one.name for one in effect.parameters]
        if names and not {*names} & {*table}:
            example = f"{names[0]} = {effect.parameters[0].typical:g}"
            hint = f"Write {enumerate_texts(names)}, as {example}; slip model fit estimates what is there."
            what = f"the effect {effect.id} has no number"
            raise self._error(what, hint, at, "id", code="no_number")

    def _vehicle(self) -> Vehicle:
        table = self.tree.get("vehicle")
        if not isinstance(table, dict):
            hint = 'Write [vehicle] and preset = "husky_a200", or kind and geometry.'
            raise self._error("the model says no vehicle", hint, None, "vehicle", code="vehicle_unknown")
        fields = _VehicleTable.__struct_fields__
        for key in table:
            if key not in fields:
                hint = _ABOVE if key in _SECTIONS else f"Known are: {', '.join(fields)}."
                what = f"unknown key {key!r} in [vehicle]"
                raise self._error(what, hint, ("vehicle", 0), key, code="unknown_key")
        section = convert_to(_VehicleTable, table)
        if isinstance(section, Fault):
            what, key = f"the vehicle is not valid: {section.what}", "".join(section.steps[:1])
            hint = section.hint or "The handbook, Configuration, lists the keys."
            raise self._error(what, hint, ("vehicle", 0), key, code="vehicle_invalid")
        try:
            return resolve_vehicle(section, recorded=None, where=str(self.path))
        except ConfigurationError as error:
            raise self._repeat(error, ("vehicle", 0), "preset") from None

    def _effect(self, number: int, table: Table) -> Effect:
        at = ("effect", number)
        name = table.get("id")
        if not isinstance(name, str) or not name:
            hint = "Write id = and one of those that `slip effects` lists."
            raise self._error("an effect needs an id", hint, at, "")
        self._check_names(at, name, table)
        formulas = {key: table[key] for key in CHANNELS if isinstance(table.get(key), str)}
        numbers = {key: value for key, value in table.items() if key not in {"id", "note", *formulas}}
        values, fixed = {}, []
        for key, raw in numbers.items():
            value, stays = self._number(at, name, key, raw, formula=bool(formulas))
            if value is not None:
                values[key] = value
            if stays:
                fixed.append(key)
        if formulas:
            refuse_taken(name, self._locate(at, "id"))
            texts = {channel: str(text) for channel, text in formulas.items()}
            return self._formula(at, name, texts, numbers, values, fixed)
        try:
            effect = find_effect(name)
        except MotionError as error:
            raise self._repeat(error, at, "id") from error
        for key, said in numbers.items():
            self._check_parameter(at, effect(), key, said, values.get(key))
        return effect().change(**values).fix(*fixed)

    def _check_names(self, at: tuple[str, int], name: str, table: Table) -> None:
        if not _ID.fullmatch(name):
            hint = "Use letters, digits, _ and -, a letter first, at most 64."
            raise self._error(f"{name[:80]!r} cannot be the id of an effect", hint, at, "id")
        for key in table:
            if not (key.isidentifier() and unicodedata.is_normalized("NFKC", key)):
                what = f"{name}: {key[:80]!r} cannot be the name of a parameter"
                raise self._error(what, "Use letters, digits and _, a letter first.", at, key)

    def _check_parameter(
        self, at: tuple[str, int], effect: Effect, key: str, said: object, value: float | None
    ) -> None:
        """One parameter alone, so that an error names its own line."""
        try:
            declared = effect.parameter(key)
            if value is not None:
                effect.change(**{key: value})
        except MotionError as error:
            raise self._repeat(error, at, key, f"{effect.id}: ") from error
        if isinstance(said, dict) and said.get("unit", declared.unit) != declared.unit:
            what = f"{effect.id}.{key} is in {declared.unit}, not in {said['unit']}"
            raise self._error(what, "Convert the value.", at, key, code="wrong_units")

    def _formula(
        self,
        at: tuple[str, int],
        name: str,
        formulas: dict[str, str],
        numbers: Table,
        values: dict[str, float],
        fixed: list[str],
    ) -> Effect:
        parameters = []
        for key, raw in numbers.items():
            table = raw if isinstance(raw, dict) else {}
            bounds = table.get("bounds", [-math.inf, math.inf])
            good = isinstance(bounds, list) and len(bounds) == 2 and all(_is_number(b) for b in bounds)  # noqa: PLR2004
            if not good or not bounds[0] < bounds[1]:
                raise self._error(f"bounds of {key} must be two numbers", "Write bounds = [-1, 1].", at, key)
            neutral = table.get("neutral", 0.0)
            if not _is_number(neutral) or not math.isfinite(neutral):
                raise self._error(f"neutral of {key} is not a finite number", "Write neutral = 1.0.", at, key)
            unit = str(table.get("unit", "1"))
            low, high = (float(bound) for bound in bounds)
            parameters.append(make_parameter(key, unit, (low, high), neutral=float(neutral)))
        lines = {key: self._locate(at, key) for key in (*formulas, *numbers)}
        try:
            where = self._locate(at, next(iter(formulas)))
            effect = FormulaEffect(name, formulas, tuple(parameters), fixed=fixed, where=where)
            return effect.change(**values)
        except MotionError as error:
            key = next(
                (k for k in lines if f" {k} " in f" {error.where} {error.what} ".replace(".", " ")), ""
            )
            where = lines.get(key) or self._locate(at, next(iter(formulas)))
            raise MotionError(error.code, f"{name}: {error.what}", where=where, hint=error.hint) from error

    def _number(
        self, at: tuple[str, int], effect: str, key: str, raw: object, *, formula: bool
    ) -> tuple[float | None, bool]:
        """Value of a parameter, and whether it is fixed in a fit."""
        if _is_number(raw):
            return float(raw), False  # type: ignore[arg-type]
        if not isinstance(raw, dict) or set(raw) - _NUMBER_KEYS:
            remark = "" if formula else " (a formula is written v_x, v_y or v_w)"
            hint = f"Write a number, or a table of {', '.join(sorted(_NUMBER_KEYS))}."
            raise self._error(f"{effect}.{key} is not a parameter{remark}", hint, at, key)
        label = f"{effect}.{key}"
        if raw.get("per_run"):
            self.per_run.append(label)
        if {"low", "high"} & set(raw):
            if not all(_is_number(raw.get(end)) for end in ("low", "high")):
                what = f"low and high of {label} are not two numbers"
                raise self._error(what, "Write both, or fit the model again.", at, key)
            low, high = float(raw["low"]), float(raw["high"])
            if not low <= high:
                what = f"low = {low:g} of {label} is above its high = {high:g}"
                raise self._error(what, "Exchange them, or fit the model again.", at, key)
            self.numbers[label] = Number(math.nan, low, high)
        if "doubt" in raw:
            count, said = raw.get("stretches", 0), str(raw["doubt"])
            if said not in DOUBTS:
                what = f"the doubt {said!r} about {label} is not known"
                raise self._error(what, "Omit it, or fit the model again.", at, key)
            noted = self.numbers.get(label, _UNKNOWN)
            stretches = count if isinstance(count, int) else 0
            self.numbers[label] = replace(noted, doubt=said, stretches=stretches)
        value = raw.get("value")
        if value is not None and not _is_number(value):
            raise self._error(f"the value of {label} is not a number", "Write value = 1.5.", at, key)
        return (None if value is None else float(value)), bool(raw.get("fixed", False))

    def _error(
        self, what: str, hint: str, at: tuple[str, int] | None, key: str, *, code: str = "model_invalid"
    ) -> MotionError:
        return MotionError(code, shorten(what), where=self._locate(at, key), hint=hint)

    def _repeat(
        self, error: SlipError, at: tuple[str, int] | None, key: str, prefix: str = ""
    ) -> MotionError:
        """An error from another module, with its line in this file."""
        return self._error(f"{prefix}{error.what}", error.hint, at, key, code=error.code)

    def _locate(self, at: tuple[str, int] | None, key: str) -> str:
        return f"{self.path}:{find_line(self.lines, at, key)}"


def find_line(lines: list[str], at: tuple[str, int] | None, key: str) -> int:
    """Line of a key, counted from one: in the ``at[1]``-th table ``at[0]``, or anywhere for None.

    If the key is not there, the line of the table's header; without a header, the first line.
    """
    header, seen, inside = 1, -1, at is None
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        if text.startswith("["):
            name = text.strip("[]").split("]")[0].strip()
            if at is None:
                if name == key or name.startswith(f"{key}."):
                    return number
                continue
            if name == at[0]:
                seen += 1
            inside = name == at[0] and seen == at[1]
            header = number if inside else header
        elif inside and re.match(rf"\"?{re.escape(key)}\"?\s*=", text) and key:
            return number
    return header


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
