"""What to add next: what the diagnosis named, then what the evidence ranks first."""

import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from pipeline.core.program import SlipError
from pipeline.estimation import Errors
from pipeline.estimation.refusal import explain_refusal
from pipeline.estimation.suggestion import Addition, Tries, rank_named
from pipeline.estimation.terms import is_term
from pipeline.models import Model
from pipeline.report.motion_view import read_model_text
from pipeline.sources import Vehicle
from pipeline.web.actions import PreparedRun
from pipeline.web.answers import evaluating
from pipeline.web.session import summarize_effect

_MOST_KEPT = 40


@dataclass
class Trial:
    """What the evidence ranks first, tried on top of one model.

    Attributes:
        owner: who asked for it.
        total: how many there are to try; None before they are ranked.
        tried: how many were.
        additions: what helps, as JSON.
        stopped: whether somebody wants it to end.
    """

    owner: str
    total: int | None = None
    tried: int = 0
    additions: list[dict[str, object]] = field(default_factory=list)
    stopped: bool = False

    @property
    def is_broken(self) -> bool:
        """Whether it was stopped before its end."""
        return self.stopped and self.tried != self.total

    def show(self) -> dict[str, object]:
        """As JSON: what helps first, by how far both errors over 2 s fall."""
        return {
            "done": self.tried == self.total,
            "tried": self.tried,
            "total": self.total,
            "found": self.additions,
        }


class Trials:
    """Trials that run or ran, by run, input and model; one thread each, the older ones of a run stopped."""

    def __init__(self) -> None:
        self._known: dict[tuple[object, ...], Trial] = {}
        self._lock = threading.Lock()
        self._in_front = 0
        self._idle = threading.Event()
        self._idle.set()

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """As long as somebody waits for an answer no further effect is tried."""
        with self._lock:
            self._in_front += 1
            self._idle.clear()
        try:
            yield
        finally:
            with self._lock:
                self._in_front -= 1
                if not self._in_front:
                    self._idle.set()

    def find(self, prepared: PreparedRun, model: Model) -> Trial | None:
        """The trial of a model, if there is one that was not stopped before its end."""
        with self._lock:
            trial = self._known.get(_key(prepared, model))
        return None if trial is None or trial.is_broken else trial

    def begin(self, prepared: PreparedRun, model: Model, owner: str) -> Trial:
        """Try what the evidence ranks first on top of a model, in the background.

        Args:
            prepared: the run.
            model: as it stands.
            owner: who asks: one trial each; what it had begun before ends.
        """
        key = _key(prepared, model)
        with self._lock:
            known = self._known.get(key)
            if known is not None and not known.is_broken:
                return known
            for trial in self._known.values():
                trial.stopped = trial.stopped or trial.owner == owner
            while len(self._known) >= _MOST_KEPT:
                self._known.pop(next(iter(self._known)))
            trial = Trial(owner)
            self._known[key] = trial
        work = (prepared, model, trial, self._idle)
        threading.Thread(target=_try_all, args=work, daemon=True).start()
        return trial


def _key(prepared: PreparedRun, model: Model) -> tuple[object, ...]:
    manifest = prepared.manifest
    return (manifest.run, manifest.key, prepared.problem.source.value, model.effects)


def _try_all(prepared: PreparedRun, model: Model, trial: Trial, idle: threading.Event) -> None:
    try:
        with evaluating(prepared.manifest.run):
            _try_each(prepared, model, trial, idle)
    except SlipError:
        # On top of a model that cannot be fitted nothing can be tried.
        trial.tried = trial.total = 0


def _try_each(prepared: PreparedRun, model: Model, trial: Trial, idle: threading.Event) -> None:
    idle.wait()
    tries = Tries(prepared.second_problem(), model)
    trial.total, additions = len(tries.candidates), list[Addition]()
    for addition in tries.try_each():
        additions += [] if addition is None else [addition]
        trial.additions = [
            show_addition(one, tries.before, prepared.vehicle) for one in tries.fold(additions)
        ]
        trial.tried += 1
        idle.wait()
        if trial.stopped:
            return


def show_addition(addition: Addition, before: Errors, vehicle: Vehicle) -> dict[str, object]:
    """What an effect would do to the errors over 2 s, as JSON."""
    effect, after = addition.effect, addition.errors
    return {
        "id": effect.id,
        "about": summarize_effect(effect),
        "sentence": "" if effect.is_neutral else effect.describe_motion(vehicle),
        "left": addition.remaining,
        "twins": list(addition.twins),
        "from": {"t": before.t_mrmse_m, "r": before.r_mrmse_rad},
        "to": {"t": after.t_mrmse_m, "r": after.r_mrmse_rad},
    }


def list_named(
    prepared: PreparedRun, model: Model, timing: Sequence[float], diagnosis: Mapping[str, object] | None
) -> list[dict[str, object]]:
    """The effects that the diagnosis of a run named and a model lacks, as JSON, the largest fall first."""
    file = None if diagnosis is None else read_model_text(diagnosis)
    if file is None:
        return []
    with prepared.lock:
        state = prepared.state(model, timing)
        before = prepared.score(model, timing)
        # The formula that was found is offered beside them.
        named = [effect for effect in file.model if not is_term(effect.id)]
        effects = [effect for effect in named if explain_refusal(effect, file.intervals) is None]
        ranked = rank_named(prepared.problem, state, effects)
    return [show_addition(one, before, prepared.vehicle) for one in ranked]
