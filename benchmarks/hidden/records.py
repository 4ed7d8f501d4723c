"""What came of played logs, one JSON line each: an interrupted scoring goes on where it was."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from draw import Answer, Category, Riddle, draw_riddle
from score import Score, score_run
from truth import Checked, Held

Outcome = Literal["scored", "failed", "timeout"]


@dataclass(frozen=True)
class Job:
    """One log to draw and to diagnose.

    Attributes:
        category, seed, effect: see `draw.draw_riddle`.
        by_command_line: run the program itself, in place of the same code in this process.
    """

    category: Category
    seed: int
    effect: str | None = None
    by_command_line: bool = False

    @property
    def name(self) -> str:
        """Name of its folder."""
        return f"{self.category}-{self.seed}-{self.effect or 'any'}{'-program' * self.by_command_line}"

    @property
    def replay(self) -> str:
        """The command that plays it again."""
        effect = f" EFFECT={self.effect}" if self.effect else ""
        return f"make hidden-effect SEED={self.seed} CATEGORY={self.category}{effect}"


@dataclass(frozen=True)
class Record:
    """One played log.

    Attributes:
        job: what was asked for.
        answer: what it hid.
        score: what was said of it; all missed where the diagnosis failed or took too long.
        checked: the true model beside the named one; None where there is none, or where it failed.
        outcome: whether a diagnosis was given.
        note: why not.
        scene: what the log was like.
        wall_s, cpu_s: time to `draw`, `ask` (of it `stages` and `diagnosis`) and `check` [s].
        version: of the code that was played with.
    """

    job: Job
    answer: Answer
    score: Score
    checked: Checked | None = None
    outcome: Outcome = "scored"
    note: str = ""
    scene: Mapping[str, object] = field(default_factory=dict)
    wall_s: Mapping[str, float] = field(default_factory=dict)
    cpu_s: Mapping[str, float] = field(default_factory=dict)
    version: str = ""

    @property
    def is_weak(self) -> bool:
        """Whether an effect that was hidden lowers the true model's held-out error by less than 5 %."""
        checked = self.checked
        return checked is not None and any(checked.is_weak(name) for name in self.answer.effects)


def describe_scene(riddle: Riddle) -> dict[str, object]:
    """What tables of scores are made by."""
    scene = riddle.scenario
    return {
        "vehicle": scene.vehicle.name,
        "layout": scene.recording.layout,
        "program": scene.program.name,
        "duration_s": scene.duration_s,
        "pose_hz": scene.pose.rate_hz,
        "noise_m": scene.pose.noise_m,
    }


def record_failure(job: Job, outcome: Outcome, note: str) -> Record:
    """A log of which no diagnosis was given: nothing was named."""
    riddle = draw_riddle(job.category, job.seed, job.effect)
    score = score_run(riddle.answer, {})
    return Record(job, riddle.answer, score, outcome=outcome, note=note, scene=describe_scene(riddle))


def append_record(record: Record, path: Path) -> None:
    """Add a line to a file of records; a line that an interruption has torn is closed first."""
    line = json.dumps(_as_json(asdict(record)), allow_nan=False, separators=(",", ":")) + "\n"
    with path.open("ab+") as stream:
        if stream.tell() > 0:
            stream.seek(-1, 2)
            if stream.read(1) != b"\n":
                stream.write(b"\n")
        stream.write(line.encode())


def read_records(paths: Iterable[Path]) -> dict[Job, Record]:
    """Records of several files by job; of a job played twice, the later line counts. Torn lines do not."""
    found: dict[Job, Record] = {}
    for path in paths:
        for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
            try:
                record = _from_json(json.loads(line))
            except json.JSONDecodeError:
                continue
            found[record.job] = record
    return found


def _as_json(value: object) -> object:
    if isinstance(value, Mapping):
        return {str(key): _as_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_as_json(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value


def _from_json(line: dict[str, dict[str, object]]) -> Record:
    content = dict(line)
    score = {key: tuple(v) if isinstance(v, list) else v for key, v in content.pop("score").items()}
    score["intervals"] = tuple(tuple(entry) for entry in score.get("intervals", ()))
    score["errors"] = tuple(math.nan if v is None else v for v in score["errors"])
    checked = content.pop("checked")
    models = None
    if checked is not None:
        without = {name: _read_held(item) for name, item in checked.pop("without").items()}
        plain = {name: None if item is None else _read_held(item) for name, item in checked.items()}
        models = Checked(**plain, without=without)
    return Record(
        Job(**content.pop("job")), Answer(**content.pop("answer")), Score(**score), models, **content
    )


def _read_held(item: Mapping[str, float | None]) -> Held:
    return Held(**{name: math.nan if value is None else value for name, value in item.items()})
