"""A session: the model of a run that a user edits, as a file and as JSON for the page."""

from __future__ import annotations

import inspect
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec

from pipeline import results
from pipeline.core import naming_os_errors, split_interval
from pipeline.models import (
    CHANNELS,
    Effect,
    FormulaEffect,
    Model,
    ModelFile,
    Parameter,
    format_model,
    list_effects,
    list_own_effects,
    make_parameter,
    name_effect,
    parse_model,
    refuse_taken,
    stands_at_bound,
)
from pipeline.results import read_result
from pipeline.sources import Vehicle
from pipeline.store import StoreError, locate_beside, make_folder, read_stored, replace_file
from pipeline.web import WorkbenchError
from pipeline.words import describe_end

SLOTS = ("a", "b")

_MOST_STEPS = 200


class Step(msgspec.Struct, frozen=True, kw_only=True):
    """One model of a session with its results.

    Attributes:
        said: short text of the action.
        model: text of its model file.
        order: ids of its effects in the order in which they were added.
        off: ids of effects that are switched off.
        timing: delays of the recording: of the poses and of the wheels [s].
        ladder: ladder steps from the ideal model upwards, as JSON.
        without: error over 2 s without one effect [m], by id.
        by_hand: whether values were set by hand since the last fit.
        refused: reasons why effects of the model are refused, by id.
    """

    said: str
    model: str
    order: list[str] = []
    off: list[str] = []
    timing: tuple[float, float] = (0.0, 0.0)
    ladder: list[dict[str, object]] = []
    without: dict[str, float] = {}
    by_hand: bool = False
    refused: dict[str, str] = {}


class Session(msgspec.Struct, frozen=True, kw_only=True):
    """All steps of an edited model.

    Attributes:
        run: the run it is fitted to.
        key: generation of the run's results that the errors belong to.
        input: `command` or `measured`.
        floor: the noise floor of the run, as JSON; empty before it was first shown.
        steps: steps, the oldest first.
        at: index of the current step; later ones can be redone.
    """

    run: str
    key: str
    input: str
    floor: dict[str, object] = {}
    steps: list[Step] = []
    at: int = -1

    @property
    def step(self) -> Step:
        """The current step.

        Raises:
            WorkbenchError: ``empty_session``.
        """
        if not 0 <= self.at < len(self.steps):
            hint = "Open the run again."
            raise WorkbenchError(
                "empty_session", "nothing has been fitted here yet", where=self.run, hint=hint
            )
        return self.steps[self.at]

    def push(self, step: Step) -> Session:
        """The session with another step; undone steps are discarded."""
        steps = [*self.steps[: self.at + 1], step][-_MOST_STEPS:]
        return msgspec.structs.replace(self, steps=steps, at=len(steps) - 1)

    def drop(self, which: int) -> Session:
        """The session without one of its steps; if it was the current one, the previous step is current."""
        steps = [step for number, step in enumerate(self.steps) if number != which]
        return msgspec.structs.replace(self, steps=steps, at=max(self.at - (which <= self.at), 0))

    def move(self, by: int) -> Session:
        """The session some steps back (negative) or forward, limited to the existing steps."""
        return msgspec.structs.replace(self, at=min(max(self.at + by, 0), len(self.steps) - 1))


@dataclass(frozen=True)
class SessionFile:
    """File of a session.

    Attributes:
        results: the results folder.
        run: name of the run.
        slot: `a`, or `b` for the second session.
    """

    results: Path
    run: str
    slot: str = field(default="a")

    @property
    def path(self) -> Path:
        """Path of the file.

        Raises:
            WorkbenchError: ``no_such_slot``.
            PathError: a link leads out of the results.
        """
        if self.slot not in SLOTS:
            raise WorkbenchError(
                "no_such_slot", f"there is no session {self.slot!r}", hint=f"Use one of {', '.join(SLOTS)}."
            )
        return locate_beside(self.results, f"desks/{self.slot}", self.run, ".json")

    @property
    def model_path(self) -> Path:
        """Path of the saved model.

        Raises:
            PathError: a link leads out of the results.
        """
        suffix = ".toml" if self.slot == "a" else f".{self.slot}.toml"
        return locate_beside(self.results, "models", self.run, suffix)

    def read(self) -> Session | None:
        """The stored session; None if there is none, or if it is unreadable."""
        try:
            return read_stored(self.path, Session)
        except StoreError:
            return None

    def write(self, session: Session) -> None:
        """Store the session.

        Raises:
            WorkbenchError: ``desk_not_written``.
        """
        hint = "Free some space, or choose a results folder that can be written."
        guard = naming_os_errors(
            WorkbenchError, "desk_not_written", "the state cannot be saved", where=self.path, hint=hint
        )
        with guard:
            make_folder(self.path.parent)
            replace_file(self.path, json.dumps(msgspec.to_builtins(session), allow_nan=False).encode())

    def parse(self, text: str) -> ModelFile:
        """The model of a step."""
        return parse_model(text, self.model_path)


def format_step(model: Model, intervals: Mapping[str, tuple[float, float]]) -> str:
    """The model text of a step."""
    return format_model(ModelFile(model, intervals=intervals))


def begin_session(run: str, key: str, source: str, vehicle: Vehicle) -> Session:
    """A new session with the ideal model, not fitted yet."""
    step = Step(said="ideal model", model=format_step(Model(vehicle), {}))
    return Session(run=run, key=key, input=source, steps=[step], at=0)


def switch_off(model: Model, off: list[str]) -> Model:
    """The model without the effects that are switched off."""
    return replace(model, effects=tuple(effect for effect in model if effect.id not in off))


_STEPS = 200
_LATEST = 12


def show_session(session: Session, file: ModelFile) -> dict[str, object]:
    """The state of a session as JSON.

    Args:
        session: session with at least one step.
        file: the model of the current step.
    """
    step = session.step
    before = session.steps[session.at - 1] if session.at > 0 else None
    floor = read_result(session.floor, results.Errors) if session.floor else None
    done, remains = describe_end(read_result(step.ladder[-1], results.Step), floor)
    return {
        "run": session.run,
        "input": session.input,
        "said": step.said,
        "by_hand": step.by_hand,
        "done": done,
        "remains": remains,
        "ideal": _errors(step.ladder[0]),
        "errors": _errors(step.ladder[-1]),
        "before": _errors(before.ladder[-1]) if before is not None and before.ladder else None,
        "floor": _errors(session.floor) if session.floor else None,
        "effects": [show_effect(file, name, step) for name in step.order],
        "undo": session.steps[session.at].said if session.at > 0 else None,
        "redo": session.steps[session.at + 1].said if session.at + 1 < len(session.steps) else None,
        "history": [each.said for each in session.steps[: session.at + 1]][-_LATEST:],
    }


def show_effect(file: ModelFile, name: str, step: Step) -> dict[str, object]:
    """Card of one effect."""
    effect = file.model.effect(name)
    return {
        "id": name,
        "about": summarize_effect(effect),
        "sentence": "" if effect.is_neutral else effect.describe_motion(file.model.vehicle, file.model),
        "formula": list_formulas(effect),
        "off": name in step.off,
        "without_m": step.without.get(name),
        "refused": step.refused.get(name),
        "parameters": [
            _show_parameter(file, effect, parameter, fitted=not step.by_hand and name not in step.off)
            for parameter in effect.parameters
            if math.isfinite(effect.values[parameter.name])
        ],
    }


def list_formulas(effect: Effect) -> list[str]:
    """What a formula adds to each channel; empty for an effect of the catalogue."""
    formulas = effect.formulas if isinstance(effect, FormulaEffect) else {}
    return [f"{key} += {text}" for key, text in formulas.items()]


def list_catalogue(vehicle: Vehicle) -> list[dict[str, object]]:
    """Every effect that exists on a vehicle, ordered from the command to the pose."""
    return [
        {
            "id": effect.id,
            "name": name_effect(effect.id),
            "about": summarize_effect(effect),
            "acts_on": effect.place.name.lower(),
        }
        for effect in (*list_effects(), *list_own_effects().values())
        if vehicle.kind in effect.kinds
    ]


def summarize_effect(effect: Effect | type[Effect]) -> str:
    """The first sentence of an effect's page, without its name."""
    if isinstance(effect, FormulaEffect):
        return "a formula"
    title = effect.find_page().splitlines()[0]
    return title.split(": ", 1)[-1].rstrip(".")


def _show_parameter(
    file: ModelFile, effect: Effect, parameter: Parameter, *, fitted: bool
) -> dict[str, object]:
    value = effect.values[parameter.name]
    # What is usual for a parameter of somebody's formula is not known: its value says how large it is.
    is_measure = isinstance(effect, FormulaEffect) and value != parameter.neutral
    low, high = find_range(parameter, value, value if is_measure else parameter.typical)
    interval = file.intervals.get(f"{effect.id}.{parameter.name}")
    # With the digits that the interval supports, as on the screen.
    said, *ends = split_interval(value, *interval) if interval else ("",)
    return {
        "name": parameter.name,
        "unit": parameter.unit,
        "about": parameter.about,
        "value": value,
        "said": said,
        "ends": ends,
        "low": interval[0] if interval else None,
        "high": interval[1] if interval else None,
        "from": low,
        "to": high,
        "step": (high - low) / _STEPS,
        "at_bound": value != parameter.neutral and stands_at_bound(value, parameter.bounds),
        "locked": parameter.name in effect.fixed,
        "undetermined": fitted and interval is None and parameter.name not in effect.fixed,
    }


def find_range(parameter: Parameter, value: float, typical: float) -> tuple[float, float]:
    """Ends of a slider within the bounds; they include the neutral, the usual and the present value."""
    is_finite = math.isfinite(parameter.neutral)
    neutral = parameter.neutral if is_finite else value
    usual = abs(typical - neutral) if is_finite else max(abs(value), abs(typical))
    usual = usual or 1.0
    low = min(neutral - usual, neutral - 2.0 * (neutral - value), value - 0.5 * usual)
    high = max(neutral + usual, neutral + 2.0 * (value - neutral), value + 0.5 * usual)
    return max(low, parameter.bounds[0]), min(high, parameter.bounds[1])


def _errors(step: Mapping[str, object]) -> dict[str, object]:
    return {"t": step.get("t_mrmse_m"), "r": step.get("r_mrmse_rad")}


_LONGEST = 400
_ID = re.compile(r"[a-z][a-z0-9_]{0,39}")
_NUMBER = r"[-+]?(?:\d{1,30}(?:\.\d{0,30})?|\.\d{1,30})(?:[eE][-+]?\d{1,3})?"
_PARAMETER = re.compile(
    r"(?P<name>[A-Za-z][A-Za-z0-9_]{0,39})\s*\[(?P<unit>[^\[\]]{0,40})\]\s*"
    rf"(?P<low>{_NUMBER})\s*(?:\.\.|to)\s*(?P<high>{_NUMBER})",
    re.ASCII,
)
_TAKEN = {"id", "note", *CHANNELS, *inspect.signature(FormulaEffect.__init__).parameters}
"""Reserved names of model files and effects."""


def make_formula(name: str, channel: str, text: str, parameters: str) -> FormulaEffect:
    """Build an effect from the typed fields.

    Args:
        name: id of the effect, in snake_case.
        channel: `v_x`, `v_y` or `v_w`.
        text: arithmetic over signals and parameters, for example `c * v0 * w0`.
        parameters: for example `c [s] -0.5 .. 0.5, d [1] 0 .. 2`.

    Raises:
        WorkbenchError: a field is invalid.
        MotionError: the formula cannot be parsed, or its unit is not the channel's.
    """
    if not _ID.fullmatch(name):
        hint = "Use small letters, digits and _, a letter first, at most 40."
        raise WorkbenchError("bad_name", f"{name!r} cannot name an effect", hint=hint)
    if channel not in CHANNELS:
        raise WorkbenchError("bad_channel", f"there is no velocity {channel!r}", hint="Use v_x, v_y or v_w.")
    if max(len(text), len(parameters)) > _LONGEST:
        raise WorkbenchError(
            "too_long", "the formula is too long", hint=f"Use at most {_LONGEST} characters."
        )
    if not text.isprintable():
        raise WorkbenchError("bad_formula", "the formula is not one line of text", hint="Write one line.")
    refuse_taken(name, "")
    declared = tuple(_read_parameter(part.strip()) for part in parameters.split(",") if part.strip())
    if len({parameter.name for parameter in declared}) < len(declared):
        raise WorkbenchError(
            "bad_parameter", "two parameters have the same name", hint="Give each a name of its own."
        )
    return FormulaEffect(name, {channel: text}, declared, where=name)


def _read_parameter(text: str) -> Parameter:
    match = _PARAMETER.fullmatch(text)
    if match is None:
        hint = "Write name [unit] low .. high, for example: c [s] -0.5 .. 0.5"
        raise WorkbenchError("bad_parameter", f"{text!r} is not a parameter", hint=hint)
    if match["name"] in _TAKEN:
        raise WorkbenchError(
            "bad_parameter", f"{match['name']!r} cannot name a parameter", hint="Choose another name."
        )
    low, high = float(match["low"]), float(match["high"])
    if not (low < high and math.isfinite(high - low)):
        raise WorkbenchError(
            "bad_parameter",
            f"the bounds of {match['name']!r} are {low:g} and {high:g}",
            hint="Give two finite numbers, the smaller one first.",
        )
    neutral = 0.0 if low <= 0.0 <= high else low
    return make_parameter(match["name"], match["unit"].strip() or "1", (low, high), neutral=neutral)
