"""The named physics beside the models of the literature and learned ones, on every real recording.

Recordings under ../shared/logs are
analyzed and diagnosed into the results where they are not yet; without recordings nothing is done, and it
says so.

Every model is judged on each recording three times, on the same predictions over 2 s: fitted to the run and
held out in it by stretches of ten seconds; fitted to another run on the same ground; fitted to a run on
another ground. Of the latter two only clocks are fitted here. A learned model adds to the ideal one;
`named + trees` adds boosted trees to the named physics. Which effects are named was decided
on the whole run: held out in the run, only their numbers are unseen. Of each model the band is told too that
held 95 % of its held-out errors of position where it was fitted, and the share of errors here that it holds.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from learners import Learned, Lesson, list_learners, score_learned
from measured_tables import render_section
from measuring import RECORDINGS, add_row, read_rows
from threadpoolctl import threadpool_limits

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core import SlipError
from pipeline.core.arrays import Floats
from pipeline.estimation import EstimationData, Fitted, HeldOut, Input, hold_out
from pipeline.estimation.rivals import Contest, Rival, hold_contest, time_fit
from pipeline.estimation.stored_diagnosis import find_diagnosis
from pipeline.estimation.transfer import fit_as_it_is
from pipeline.models import Model
from pipeline.models.effect import Late
from pipeline.models.literature import list_models
from pipeline.results.reading import read_model
from pipeline.run import load_motion_run
from pipeline.sources.one_vehicle import load_vehicle
from pipeline.store import Manifest, Store

NAMED, IDEAL, TREES, BEYOND = "named physics", "ideal", "learned_trees", "named + trees"
PLACES = ("in the run", "same ground", "other ground")
METRICS = ("t_mrmse_m", "r_mrmse_rad")
BAND = 0.95


@dataclass(frozen=True)
class Entry:
    """A model fitted to a recording.

    Attributes:
        rival: its held-out errors there.
        fitted: the physics of it.
        learned: what was learned beyond; None without.
    """

    rival: Rival
    fitted: Fitted
    learned: Learned | None = None

    @property
    def band_m(self) -> float:
        """What holds 95 % of its held-out errors of position [m]."""
        return float(np.nanquantile(self.rival.list_errors("t_mrmse_m"), BAND))

    def carry_to(self, other: Recording) -> HeldOut:
        """Its errors on another recording: clocks are fitted there, all else is as it is."""
        model = self.fitted.model
        clocks = [f"{e.id}.{name}" for e in model if e.late is Late.POSES for name in e.values]
        there = fit_as_it_is(other.data, model, clocks)
        if self.learned is None:
            return hold_out(other.data, there)
        return score_learned(other.data, there.state, self.learned)


class Recording:
    """A diagnosed recording, and all models fitted to it."""

    def __init__(self, manifest: Manifest, store: Store, source: Input, *, learns: bool) -> None:
        self.name = Path(manifest.run).name
        found = find_diagnosis(store.root, manifest)
        file = None if found is None else read_model(found)
        if file is None or not file.model.effects:
            what = "no effect is named: it did not move, or nothing could be judged"
            raise SlipError("not_diagnosed", what, where=self.name, hint="Take another one.")
        self.vehicle = load_vehicle(manifest)
        run = load_motion_run(manifest, self.vehicle)
        self.terrain, self.duration_s = run.terrain, run.duration_s
        self.data = EstimationData([run], self.vehicle, source)
        self.models = {NAMED: Model(self.vehicle, file.model.effects)}
        self.models |= {model.name: model.make(self.vehicle) for model in list_models(self.vehicle)}
        self._learns = learns

    @cached_property
    def entries(self) -> dict[str, Entry]:
        """All models, fitted to the recording."""
        found = {}
        for name, model in self.models.items():
            fitted, fit_s = time_fit(self.data, model)
            numbers = len({number.label for number in fitted.free if number.effect})
            found[name] = Entry(Rival(name, numbers, hold_out(self.data, fitted), fit_s), fitted)
        if not self._learns:
            return found
        for learner in list_learners():
            lesson = Lesson(self.data, learner)
            found[learner.name] = self._learn(learner.name, found[IDEAL].fitted, lesson)
            if learner.name == TREES:
                found[BEYOND] = self._learn(BEYOND, found[NAMED].fitted, lesson)
        return found

    def _learn(self, name: str, fitted: Fitted, lesson: Lesson) -> Entry:
        begun = time.process_time()
        learned = lesson.learn(fitted.state, np.ones(self.data.whole.run.size, dtype=bool))
        fit_s = time.process_time() - begun
        rival = Rival(name, None, hold_out(self.data, fitted, lesson.learn_fold), fit_s)
        return Entry(rival, fitted, learned)

    def contest(self, source: Recording | None = None) -> tuple[Contest, dict[str, float]]:
        """All models here, held out or carried over from a recording, and what share their bands hold."""
        own = self.entries
        if source is None:
            rivals = {name: entry.rival for name, entry in own.items()}
            bands = {}
        else:
            rivals = {
                name: Rival(name, entry.rival.numbers, entry.carry_to(self), entry.rival.fit_s)
                for name, entry in source.entries.items()
            }
            bands = {name: entry.band_m for name, entry in source.entries.items()}
        held = {
            name: _share_below(rivals[name].list_errors("t_mrmse_m"), band) for name, band in bands.items()
        }
        return hold_contest(self.data, list(rivals.values())), held


def _share_below(errors: Floats, band: float) -> float:
    return float(np.mean(errors[np.isfinite(errors)] <= band))


def open_recordings(store: Store, source: Input, logs: Iterable[Path], *, learns: bool) -> list[Recording]:
    found = []
    for log in logs:
        manifest = analyze_log(log, Options(out=store.root, report=False, diagnosis=True)).manifest
        try:
            found.append(Recording(manifest, store, source, learns=learns))
        except SlipError as error:
            print(f"{log.stem}: left out, {error.what}")
    return found


def choose_donors(target: Recording, all_of_them: Sequence[Recording]) -> dict[str, Recording | None]:
    """For each place, the recording that a model comes from; the target's own for itself."""
    same = [one for one in all_of_them if one.vehicle.id == target.vehicle.id]
    place = same.index(target)
    after = [*same[place + 1 :], *same[:place]]
    donors: dict[str, Recording | None] = {PLACES[0]: None}
    for name, is_same in ((PLACES[1], True), (PLACES[2], False)):
        chosen = next((one for one in after if (one.terrain == target.terrain) is is_same), None)
        if chosen is not None:
            donors[name] = chosen
    return donors


def judge(target: Recording, place: str, donor: Recording | None) -> dict[str, object]:
    """A row: all models at one place."""
    contest, held = target.contest(donor)
    named = next(rival for rival in contest.rivals if rival.name == NAMED)

    def compare(rival: Rival) -> dict[str, object]:
        behind = {metric: contest.measure(rival, named, metric) for metric in METRICS}
        return {
            "numbers": rival.numbers,
            "fit_s": round(rival.fit_s, 2),
            "band_holds": held.get(rival.name),
            **{metric: rival.read(metric) for metric in METRICS},
            **{f"{metric}_over_named": [one.value, one.low, one.high] for metric, one in behind.items()},
        }

    return {
        "run": target.name,
        "vehicle": target.vehicle.id,
        "terrain": target.terrain,
        "input": target.data.source.value,
        "minutes": round(target.duration_s / 60.0, 1),
        "place": place,
        "donor": "" if donor is None else donor.name,
        "donor_terrain": "" if donor is None else donor.terrain,
        "models": {rival.name: compare(rival) for rival in contest.rivals},
    }


Row = Mapping[str, object]
Judged = Mapping[str, Mapping[str, object]]


def read_models(row: Row) -> Judged:
    return row["models"]  # type: ignore[return-value]


def mark(models: Judged, name: str, metric: str) -> str:
    """Better than the named physics (+), worse (-), or a difference within its interval (=)."""
    _, low, high = models[name][f"{metric}_over_named"]  # type: ignore[misc]
    return "-" if low > 0.0 else "+" if high < 0.0 else "="


def find_best(models: Judged, names: Iterable[str], metric: str) -> str:
    return min(names, key=lambda name: read_error(models, name, metric))


def list_groups(models: Judged) -> dict[str, list[str]]:
    learned = [name for name in models if name.startswith("learned_")]
    literature = [name for name in models if name not in {NAMED, BEYOND, *learned}]
    beyond = [BEYOND] if BEYOND in models else []
    return {"literature": literature, "learned": learned, BEYOND: beyond}


def describe_sections(rows: Sequence[Row]) -> list[dict[str, object]]:
    """Tables by place and metric, as `measured_tables.render_section` shows them."""
    sections: list[dict[str, object]] = []
    for place in PLACES:
        here = [row for row in rows if row["place"] == place]
        for metric, words in zip(METRICS, ("position", "heading"), strict=True) if here else ():
            head = ["recording", "from", IDEAL, NAMED, "best of the literature", "best learned", BEYOND]
            cells = [list_cells(row, metric) for row in here]
            sections.append(
                {"place": place, "metric": words, "head": head, "rows": cells, **summarize(here, metric)}
            )
    return sections


def print_tables(rows: Sequence[Row]) -> None:
    """Markdown: a table for each place and metric, and how often who won."""
    for section in describe_sections(rows):
        print(f"\n## {section['place']}\n")
        print("\n".join(render_section(section)))


def name_recording(row: Row) -> str:
    """A recording in words: its vehicle, its terrain, and the month and day that its name has."""
    date = re.search(r"_\d{4}_(\d+)_(\d+)_", str(row["run"]))
    words = [str(row["vehicle"]).partition("_")[0].capitalize(), str(row["terrain"])]
    return " ".join([*words, *([f"{int(date[1]):02}-{int(date[2]):02}"] if date else [])])


def read_error(models: Judged, name: str, metric: str) -> float:
    return float(models[name][metric])  # type: ignore[arg-type]


def show(models: Judged, name: str, metric: str) -> str:
    value = read_error(models, name, metric)
    return f"{value:.3f}" if metric == METRICS[0] else f"{math.degrees(value):.2f}"


def list_cells(row: Row, metric: str) -> list[str]:
    models = read_models(row)
    cells = [name_recording(row), str(row["donor_terrain"]) or "itself"]
    cells += [show(models, name, metric) for name in (IDEAL, NAMED)]
    for names in list_groups(models).values():
        if names:
            best = find_best(models, names, metric)
            label = "" if best == BEYOND else f"{best} "
            cells.append(f"{label}{show(models, best, metric)} {mark(models, best, metric)}")
        else:
            cells.append("")
    return cells


def summarize(rows: Sequence[Row], metric: str) -> dict[str, object]:
    """How often who is better or worse than the named physics, errors that are gone, and what bands hold."""
    judged = [read_models(row) for row in rows]
    wins = {}
    for group in list_groups(judged[0]):
        marks = [
            mark(models, find_best(models, names, metric), metric)
            for models in judged
            if (names := list_groups(models)[group])
        ]
        if marks:
            wins[group] = [marks.count("+"), marks.count("-"), len(marks)]
    gone = {
        name: np.median(
            [1.0 - read_error(one, name, metric) / read_error(one, IDEAL, metric) for one in judged]
        )
        for name in (NAMED, BEYOND)
        if all(name in one for one in judged)
    }
    bands = {}
    for name in (NAMED, TREES, BEYOND) if metric == METRICS[0] else ():
        held = [one[name]["band_holds"] for one in judged if name in one]
        shares = [round(share, 4) for share in held if isinstance(share, float)]
        if shares:
            bands[name] = shares
    return {
        "wins": wins,
        "gone": {name: round(float(share), 4) for name, share in gone.items()},
        "bands": bands,
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--results", type=Path, default=Path("build/rivals"))
    parser.add_argument("--input", choices=("command", "measured"), default="command")
    parser.add_argument("--run", default="", help="only recordings with this in their names")
    parser.add_argument("--no-learned", action="store_true")
    parser.add_argument("--rows", type=Path, help="JSON lines to add rows to; those that are there are kept")
    parser.add_argument("--table", type=Path, help="print the tables of these rows, and judge nothing")


def run(chosen: argparse.Namespace) -> None:
    if chosen.table:
        print_tables(read_rows(chosen.table))
        return
    logs = sorted(RECORDINGS.glob("*.mcap"))
    if not logs:
        print(f"skipped: no recordings in {RECORDINGS.name}")
        return
    done = read_rows(chosen.rows)
    known = {(row["run"], row["place"], row["input"]) for row in done}
    with threadpool_limits(1):
        learns = not chosen.no_learned
        found = open_recordings(Store(chosen.results), Input(chosen.input), logs, learns=learns)
        for target in (one for one in found if chosen.run in one.name):
            for place, donor in choose_donors(target, found).items():
                if (target.name, place, chosen.input) in known:
                    continue
                row = judge(target, place, donor)
                done.append(row)
                add_row(chosen.rows, row)
                print(f"{target.name}, {place}: judged", file=sys.stderr, flush=True)
    print_tables([row for row in done if row["input"] == chosen.input])
