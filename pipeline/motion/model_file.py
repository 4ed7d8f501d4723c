"""The model file: TOML that people read, diff and commit; every error names its line."""

from __future__ import annotations

import math
import re
import tomllib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import msgspec

from pipeline.motion.catalogue import find_effect, load_effects
from pipeline.motion.errors import MotionError
from pipeline.motion.formula.formula_effect import CHANNELS, FormulaEffect, make_parameter
from pipeline.motion.model import Model
from pipeline.vehicles import ConfigurationError, resolve_vehicle
from pipeline.vehicles.configuration import VehicleSection

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from pipeline.motion.catalogue import EffectClass
    from pipeline.motion.effect import Effect
    from pipeline.vehicles import Vehicle

FORMAT = 1
_SECTIONS = ("format", "effects", "vehicle", "effect", "fit", "note")
_NUMBER_KEYS = {"value", "low", "high", "unit", "bounds", "neutral", "fixed", "per_run"}
_LINE = re.compile(r"\(at line (\d+)")

Table = dict[str, object]


@dataclass(frozen=True)
class ModelFile:
    """A model and what its file says beside it.

    Attributes:
        model: vehicle and effects with their values.
        effect_files: files of the user's own effects, as written.
        per_run: labels ``effect.name`` whose values belong to each run alone.
        intervals: 95 % intervals of the last fit by label.
        fit: what the last fit was: input, runs with hashes, delays, ladder; empty before one.
        note: free text.
    """

    model: Model
    effect_files: tuple[str, ...] = ()
    per_run: tuple[str, ...] = ()
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    fit: Mapping[str, object] = field(default_factory=dict)
    note: str = ""


def read_model(path: Path) -> ModelFile:
    """Read a model file.

    Raises:
        MotionError: the file is missing, not TOML, or says something that cannot be; with its line.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise MotionError(
            "model_not_found",
            "there is no such model file",
            where=str(path),
            hint=f"Make one: slip model new {path.name} --vehicle husky_a200.",
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise MotionError(
            "model_unreadable", f"cannot be read: {error}", where=str(path), hint="Check the file."
        ) from None
    return parse_model(text, path)


def parse_model(text: str, path: Path) -> ModelFile:
    """Parse the text of a model file; see `read_model`.

    Args:
        text: TOML.
        path: where it stands; files of effects are looked up beside it.
    """
    return _Reader(text, path).read()


class _Reader:
    """One file: its text for line numbers, its tables, and what was found so far."""

    def __init__(self, text: str, path: Path) -> None:
        self.lines = text.splitlines()
        self.path = path
        try:
            self.tree: Table = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            found = _LINE.search(str(error))
            line = int(found.group(1)) if found else len(self.lines)
            raise MotionError(
                "model_not_toml",
                f"not a valid TOML file: {error}",
                where=f"{path}:{line}",
                hint="Mend that line.",
            ) from None
        self.per_run: list[str] = []
        self.intervals: dict[str, tuple[float, float]] = {}

    def read(self) -> ModelFile:
        """The whole file."""
        for key in self.tree:
            if key not in _SECTIONS:
                raise self._error(
                    "unknown_key", f"unknown key {key!r}", f"Known are: {', '.join(_SECTIONS)}.", None, key
                )
        if self.tree.get("format", FORMAT) != FORMAT:
            raise self._error(
                "model_too_new",
                f"format {self.tree['format']!r} is not known",
                f"This version reads format {FORMAT}.",
                None,
                "format",
            )
        files = self._texts("effects")
        own: dict[str, EffectClass] = {}
        for name in files:
            try:
                own |= load_effects(self.path.parent / name)
            except MotionError as error:
                raise self._error(error.code, error.what, error.hint, None, "effects") from error
        vehicle = self._vehicle()
        tables = self.tree.get("effect", [])
        if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
            raise self._error(
                "model_invalid", "effects are written as [[effect]]", "Double the brackets.", None, "effect"
            )
        effects: list[Effect] = []
        for number, table in enumerate(tables):
            effects.append(self._effect(number, table, own))
            self._check_composition(number, vehicle, effects)
        fit = self.tree.get("fit", {})
        return ModelFile(
            model=Model(vehicle, tuple(effects)),
            effect_files=files,
            per_run=tuple(self.per_run),
            intervals=self.intervals,
            fit=fit if isinstance(fit, dict) else {},
            note=str(self.tree.get("note", "")),
        )

    def _vehicle(self) -> Vehicle:
        table = self.tree.get("vehicle")
        if not isinstance(table, dict):
            raise self._error(
                "vehicle_unknown",
                "the model says no vehicle",
                'Write [vehicle] and preset = "husky_a200", or kind and geometry.',
                None,
                "vehicle",
            )
        try:
            section = msgspec.convert(table, VehicleSection)
            return resolve_vehicle(section, recorded=None, where=str(self.path))
        except msgspec.ValidationError as error:
            raise self._error(
                "vehicle_invalid",
                f"the vehicle is not valid: {error}",
                "See README.md, Configuration, for the keys.",
                ("vehicle", 0),
                "",
            ) from None
        except ConfigurationError as error:
            raise self._error(error.code, error.what, error.hint, ("vehicle", 0), "preset") from None

    def _effect(self, number: int, table: Table, own: Mapping[str, EffectClass]) -> Effect:
        at = ("effect", number)
        name = table.get("id")
        if not isinstance(name, str) or not name:
            raise self._error(
                "model_invalid",
                "an effect needs an id",
                "Write id = and one of those that `slip effects` lists.",
                at,
                "",
            )
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
            texts = {channel: str(text) for channel, text in formulas.items()}
            return self._formula(at, name, texts, numbers, values, fixed)
        try:
            effect = find_effect(name, own)
        except MotionError as error:
            raise self._error(error.code, error.what, error.hint, at, "id") from error
        for key, said in numbers.items():
            self._check_parameter(at, effect(), key, said, values.get(key))
        return self._make(effect, fixed, values)

    def _make(self, effect: EffectClass, fixed: list[str], values: dict[str, float]) -> Effect:
        return effect().change(**values).fix(*fixed)

    def _check_parameter(
        self, at: tuple[str, int], effect: Effect, key: str, said: object, value: float | None
    ) -> None:
        """One parameter alone, so that an error names its own line."""
        try:
            declared = effect.parameter(key)
            if value is not None:
                effect.change(**{key: value})
        except MotionError as error:
            raise self._error(error.code, f"{effect.id}: {error.what}", error.hint, at, key) from error
        if isinstance(said, dict) and said.get("unit", declared.unit) != declared.unit:
            raise self._error(
                "wrong_units",
                f"{effect.id}.{key} is in {declared.unit}, not in {said['unit']}",
                "Convert the value.",
                at,
                key,
            )

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
                raise self._error(
                    "model_invalid",
                    f"bounds of {key} must be two numbers",
                    "Write bounds = [-1, 1].",
                    at,
                    key,
                )
            neutral = table.get("neutral", 0.0)
            unit = str(table.get("unit", "1"))
            low, high = (float(bound) for bound in bounds)
            parameters.append(make_parameter(key, unit, (low, high), neutral=float(neutral)))
        lines = {key: self._place(at, key) for key in (*formulas, *numbers)}
        try:
            return FormulaEffect(
                name,
                formulas,
                tuple(parameters),
                fixed=fixed,
                where=self._place(at, next(iter(formulas))),
                **values,
            )
        except MotionError as error:
            key = next(
                (k for k in lines if f" {k} " in f" {error.where} {error.what} ".replace(".", " ")), ""
            )
            place = lines.get(key) or self._place(at, next(iter(formulas)))
            raise MotionError(error.code, f"{name}: {error.what}", where=place, hint=error.hint) from error

    def _number(
        self, at: tuple[str, int], effect: str, key: str, raw: object, *, formula: bool
    ) -> tuple[float | None, bool]:
        """Value of a parameter and whether a fit leaves it alone."""
        if _is_number(raw):
            return float(raw), False  # type: ignore[arg-type]
        if not isinstance(raw, dict) or set(raw) - _NUMBER_KEYS:
            more = "" if formula else " (a formula is written v_x, v_y or v_w)"
            raise self._error(
                "model_invalid",
                f"{effect}.{key} is no parameter{more}",
                f"Write a number, or a table of {', '.join(sorted(_NUMBER_KEYS))}.",
                at,
                key,
            )
        label = f"{effect}.{key}"
        if raw.get("per_run"):
            self.per_run.append(label)
        if _is_number(raw.get("low")) and _is_number(raw.get("high")):
            self.intervals[label] = (float(raw["low"]), float(raw["high"]))
        value = raw.get("value")
        if value is not None and not _is_number(value):
            raise self._error(
                "model_invalid", f"the value of {label} is no number", "Write value = 1.5.", at, key
            )
        return (None if value is None else float(value)), bool(raw.get("fixed", False))

    def _check_composition(self, number: int, vehicle: Vehicle, effects: list[Effect]) -> None:
        try:
            Model(vehicle, tuple(effects))
        except MotionError as error:
            raise self._error(error.code, error.what, error.hint, ("effect", number), "id") from error

    def _texts(self, key: str) -> tuple[str, ...]:
        value = self.tree.get(key, [])
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise self._error(
                "model_invalid", f"{key} is a list of file names", f'Write {key} = ["a.py"].', None, key
            )
        return tuple(value)

    def _error(self, code: str, what: str, hint: str, at: tuple[str, int] | None, key: str) -> MotionError:
        return MotionError(code, what, where=self._place(at, key), hint=hint)

    def _place(self, at: tuple[str, int] | None, key: str) -> str:
        return f"{self.path}:{find_line(self.lines, at, key)}"


def find_line(lines: list[str], at: tuple[str, int] | None, key: str) -> int:
    """Line of a key, counted from one: in the ``at[1]``-th table ``at[0]``, or anywhere for None.

    Where the key does not stand there, the line of the table's header; where there is none, the first line.
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
        elif inside and re.match(rf"{re.escape(key)}\s*=", text) and key:
            return number
    return header


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
