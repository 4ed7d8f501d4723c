"""A session: a model of a run in the making and every step back to the ideal one, in one file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec

from pipeline.core.errors import naming_os_errors
from pipeline.core.paths import resolve_inside
from pipeline.models import Model
from pipeline.models.model_file import ModelFile, parse_model
from pipeline.models.model_text import format_model
from pipeline.store.files import make_folder, replace_file
from pipeline.store.names import encode_run
from pipeline.vehicles import Vehicle
from pipeline.web.errors import WorkbenchError

SLOTS = ("a", "b")
FOLDER = "workbench"

_MOST_STEPS = 200


class Step(msgspec.Struct, frozen=True, kw_only=True):
    """A model on the session and what is known of it.

    Attributes:
        said: what was done, in a few words.
        model: text of its model file.
        order: ids of its effects in the order in which they were added.
        off: ids of effects that are switched off.
        timing: delays of the recording: of the poses and of the wheels [s].
        ladder: rungs from the ideal model up, as JSON.
        without: error over 2 s [m] when an effect alone is dropped, by id.
        by_hand: whether values were set by hand since the last fit.
    """

    said: str
    model: str
    order: list[str] = []
    off: list[str] = []
    timing: tuple[float, float] = (0.0, 0.0)
    ladder: list[dict[str, object]] = []
    without: dict[str, float] = {}
    by_hand: bool = False


class Session(msgspec.Struct, frozen=True, kw_only=True):
    """All steps of a model in the making.

    Attributes:
        run: the run it is fitted to.
        key: generation of the run's results that the errors belong to.
        input: what the model is fed with.
        floor: the noise floor of the run, as JSON; empty before it was first shown.
        steps: oldest first.
        at: which step counts: those after it can be redone.
    """

    run: str
    key: str
    input: str
    floor: dict[str, object] = {}
    steps: list[Step] = []
    at: int = -1

    @property
    def step(self) -> Step:
        """The step that counts.

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
        """The session after another step; what had been undone is forgotten."""
        steps = [*self.steps[: self.at + 1], step][-_MOST_STEPS:]
        return msgspec.structs.replace(self, steps=steps, at=len(steps) - 1)

    def drop(self, which: int) -> Session:
        """The session without one of its steps; before it where that one counted."""
        steps = [step for number, step in enumerate(self.steps) if number != which]
        return msgspec.structs.replace(self, steps=steps, at=max(self.at - (which <= self.at), 0))

    def move(self, by: int) -> Session:
        """The session some steps back (negative) or forward, as far as there are any."""
        return msgspec.structs.replace(self, at=min(max(self.at + by, 0), len(self.steps) - 1))


@dataclass(frozen=True)
class SessionFile:
    """Where a session is kept.

    Attributes:
        results: the results folder.
        run: name of the run.
        slot: `a`, or `b` for the one beside it.
    """

    results: Path
    run: str
    slot: str = field(default="a")

    @property
    def path(self) -> Path:
        """The file.

        Raises:
            WorkbenchError: ``no_such_slot``.
            PathError: a link leads out of the results.
        """
        if self.slot not in SLOTS:
            raise WorkbenchError(
                "no_such_slot", f"there is no session {self.slot!r}", hint=f"Use one of {', '.join(SLOTS)}."
            )
        return place_of_run(self.results, f"desks/{self.slot}", self.run, ".json")

    @property
    def model_path(self) -> Path:
        """Where the model is saved.

        Raises:
            PathError: a link leads out of the results.
        """
        suffix = ".toml" if self.slot == "a" else f".{self.slot}.toml"
        return place_of_run(self.results, "models", self.run, suffix)

    def read(self) -> Session | None:
        """The session; None when there is none that can be read."""
        try:
            return msgspec.json.decode(self.path.read_bytes(), type=Session)
        except (OSError, ValueError, msgspec.DecodeError, RecursionError):
            return None

    def write(self, session: Session) -> None:
        """Keep the session.

        Raises:
            WorkbenchError: ``desk_not_written``.
        """
        hint = "Free some space, or choose a results folder that can be written."
        kept = naming_os_errors(
            WorkbenchError, "desk_not_written", "the state cannot be kept", where=self.path, hint=hint
        )
        with kept:
            make_folder(self.path.parent)
            replace_file(self.path, json.dumps(msgspec.to_builtins(session), allow_nan=False).encode())

    def parse(self, text: str) -> ModelFile:
        """The model of a step."""
        return parse_model(text, self.model_path)


def format_step(model: Model, intervals: Mapping[str, tuple[float, float]]) -> str:
    """The model text of a step."""
    return format_model(ModelFile(model, intervals=intervals))


def begin_session(run: str, key: str, source: str, vehicle: Vehicle) -> Session:
    """A session with the ideal model on it, not fitted yet."""
    step = Step(said="ideal model", model=format_step(Model(vehicle), {}))
    return Session(run=run, key=key, input=source, steps=[step], at=0)


def switch_off(model: Model, off: list[str]) -> Model:
    """The model without the effects that are switched off."""
    return replace(model, effects=tuple(effect for effect in model if effect.id not in off))


def place_of_run(results: Path, folder: str, run: str, suffix: str) -> Path:
    """Where the workbench keeps something of a run: in the results, which may be a stranger's.

    Raises:
        PathError: a link leads out of the results, or a pipe or device stands there.
    """
    place = encode_run(run)
    return resolve_inside(results, f"{FOLDER}/{folder}/{place.with_name(f'{place.name}{suffix}')}")
