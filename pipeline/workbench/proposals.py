"""What to add next: each effect of the catalogue tried on top of the model, and what a diagnosis named."""

from __future__ import annotations

import json
import threading
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pipeline.motion import MotionError, fit_model, hold_out, list_effects
from pipeline.motion.ladder import compare_losses
from pipeline.workbench.cards import describe_shortly

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.motion import HeldOut, Model
    from pipeline.store import Manifest
    from pipeline.workbench.bench import Stand

DIAGNOSIS = "diagnosis.json"

_WORTH = 0.995
_EACH_NUMBER = 1.02
_MOST_KEPT = 40


@dataclass
class Trial:
    """Every effect tried on top of one model.

    Attributes:
        total: how many there are to try.
        tried: how many were.
        found: what each would do, as JSON.
        stopped: whether somebody wants it to end.
    """

    total: int
    tried: int = 0
    found: list[dict[str, object]] = field(default_factory=list)
    stopped: bool = False

    def show(self) -> dict[str, object]:
        """As JSON: those that help first."""
        ranked = sorted(self.found, key=lambda entry: (not entry["helps"], entry["rank"]))
        return {"total": self.total, "tried": self.tried, "found": ranked}


class Trials:
    """Trials that run or ran, by run, input and model; one thread each, the older ones of a run stopped."""

    def __init__(self) -> None:
        self._known: dict[tuple[object, ...], Trial] = {}
        self._lock = threading.Lock()

    def find(self, stand: Stand, model: Model) -> Trial | None:
        """The trial of a model, if there was one."""
        with self._lock:
            return self._known.get(_key(stand, model))

    def begin(self, stand: Stand, model: Model) -> Trial:
        """Try every effect on top of a model, in the background."""
        key = _key(stand, model)
        with self._lock:
            if key in self._known:
                return self._known[key]
            for other, trial in self._known.items():
                trial.stopped = trial.stopped or other[:3] == key[:3]
            while len(self._known) >= _MOST_KEPT:
                self._known.pop(next(iter(self._known)))
            kinds = [
                effect
                for effect in list_effects()
                if stand.vehicle.kind in effect.kinds and effect.id not in model
            ]
            trial = Trial(len(kinds))
            self._known[key] = trial
        names = [effect.id for effect in kinds]
        threading.Thread(target=_try_all, args=(stand, model, names, trial), daemon=True).start()
        return trial

    def forget_stopped(self) -> None:
        """Forget trials that did not end, so that they may begin again."""
        with self._lock:
            for key in [k for k, trial in self._known.items() if trial.stopped and trial.tried < trial.total]:
                del self._known[key]


def _key(stand: Stand, model: Model) -> tuple[object, ...]:
    manifest = stand.manifest
    return (manifest.run, manifest.key, stand.problem.source.value, model.effects)


def _try_all(stand: Stand, model: Model, names: list[str], trial: Trial) -> None:
    problem = stand.coarse_problem()
    base: HeldOut = hold_out(problem, fit_model(problem, model))
    kinds = {effect.id: effect for effect in list_effects()}
    for name in names:
        if trial.stopped:
            return
        added = model + kinds[name]()
        if len(problem.active_effects(added)) > len(problem.active_effects(model)):
            try:
                held_out = hold_out(problem, fit_model(problem, added))
            except (MotionError, ArithmeticError, ValueError):
                # What cannot be fitted to this run is no proposal.
                held_out = base
            ratio = compare_losses(held_out, base)
            trial.found.append(
                {
                    "id": name,
                    "about": describe_shortly(kinds[name]),
                    "ratio": ratio,
                    # Of two that do the same, the one with fewer numbers.
                    "rank": ratio * _EACH_NUMBER ** len(kinds[name].parameters),
                    "helps": ratio < _WORTH,
                    "from": {"t": base.pooled.t_mrmse_m, "r": base.pooled.r_mrmse_rad},
                    "to": {"t": held_out.pooled.t_mrmse_m, "r": held_out.pooled.r_mrmse_rad},
                }
            )
        trial.tried += 1


def read_diagnosis(manifest: Manifest) -> Mapping[str, object] | None:
    """What `slip diagnose` stored with a run; None where it did not."""
    if DIAGNOSIS not in manifest.files:
        return None
    content = json.loads(manifest.path(DIAGNOSIS).read_text(encoding="utf-8"))
    return content if isinstance(content, dict) else None
