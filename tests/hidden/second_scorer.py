"""HiddenEffect's scores a second time, from docs/pages/hidden_effect.md alone: plain dicts, no numpy.

It reads neither the scorer of the benchmark nor its helpers; a test compares the two on random answers.
"""

from __future__ import annotations

import json
import math
import random
import statistics
from collections import Counter
from typing import Any, Literal

import msgspec

NAN = float("nan")


class Number(msgspec.Struct, forbid_unknown_fields=True):
    value: float
    low: float | None = None
    high: float | None = None


class Effect(msgspec.Struct, forbid_unknown_fields=True):
    name: str
    parameters: dict[str, Number] = {}


class Other(msgspec.Struct, forbid_unknown_fields=True):
    channels: list[Literal["x", "y", "yaw"]]
    formula: str = ""


class Said(msgspec.Struct, forbid_unknown_fields=True):
    format: Literal["hidden-effect-answer/1"]
    task: str
    effects: list[Effect] = []
    none: bool = False
    undecided: list[list[str]] = []
    other: Other | None = None
    poses: list[tuple[float, float, float]] | None = None
    cpu_s: float | None = None


def refuse_twice(pairs: list[tuple[str, Any]]) -> None:
    """An error where a key stands twice."""
    if Counter(key for key, _ in pairs).most_common(1)[0][1] > 1:
        raise ValueError


def decode(raw: bytes, task: str, windows: int, listed: dict[str, Any]) -> Said | None:
    """The answer, or None where the page calls it an error."""
    if len(raw) > 1_000_000:
        return None
    try:
        said = msgspec.json.decode(raw, type=Said)
        json.loads(raw, object_pairs_hook=refuse_twice)
    except (ValueError, RecursionError):
        return None
    names = [effect.name for effect in said.effects]
    numbers = [number for effect in said.effects for number in effect.parameters.values()]
    flat = [value for number in numbers for value in (number.value, number.low, number.high)]
    flat += [value for pose in said.poses or [] for value in pose] + [said.cpu_s]
    rules = [
        said.task == task,
        len(names) <= 10 and len(set(names)) == len(names),
        all(name in listed for name in (*names, *(one for group in said.undecided for one in group))),
        all(
            key in listed[effect.name]["parameters"]
            for effect in said.effects
            if effect.name in listed
            for key in effect.parameters
        ),
        all(abs(value) <= 1e9 for value in flat if value is not None),
        all((number.low is None) == (number.high is None) for number in numbers),
        all(number.low <= number.value <= number.high for number in numbers
            if number.low is not None and number.high is not None),
        len(said.undecided) <= 5,
        all(2 <= len(group) <= 6 and len(set(group)) == len(group) for group in said.undecided),
        not any(one in names for group in said.undecided for one in group),
        not (said.none and (names or said.undecided or said.other)),
        said.other is None or (bool(said.other.channels) and len(said.other.formula) <= 2000),
        said.poses is None or len(said.poses) == windows,
        said.cpu_s is None or said.cpu_s >= 0.0,
    ]  # fmt: skip
    return said if all(rules) else None


def count_found(truth: dict[str, Any], said: Said) -> tuple[float, Counter[str]]:
    """Credit, and how many of what is hidden are right, undecided and left; of an empty log `nothing`."""
    if not truth["effects"] and not truth["unlisted"]:
        return float(said.none), Counter(right=int(said.none), left=int(not said.none))
    credit, found = 0.0, Counter[str]()
    for effect in truth["effects"]:
        words = {effect["name"], *effect["same_as"]}
        sizes = sorted(len(group) for group in said.undecided if not words.isdisjoint(group))
        fate = "right" if words & {one.name for one in said.effects} else "undecided" if sizes else "left"
        credit += {"right": 1.0, "undecided": 1.0 / sizes[0] if sizes else 0.0, "left": 0.0}[fate]
        found[fate] += 1
    if truth["unlisted"]:
        hit = said.other is not None and not {*said.other.channels}.isdisjoint(truth["unlisted"]["channels"])
        credit += hit
        found["right" if hit else "left"] += 1
    return credit, found


def count_false(truth: dict[str, Any], said: Said, found: Counter[str]) -> int:
    """Claims that are not true."""
    mercy = {*truth["tolerated"]}
    kind = {name for effect in truth["effects"] for name in (effect["name"], *effect["same_as"])}
    claims = [{effect.name} for effect in said.effects] + [{*group} for group in said.undecided]
    foreign = [claim for claim in claims if claim.isdisjoint(kind)]
    empty = not truth["effects"] and not truth["unlisted"]
    nothing_open = empty or not found["left"]
    beside = found["left"] if truth["unlisted"] else nothing_open
    other = said.other is not None and "other" not in mercy and bool(beside)
    return (
        sum(mercy.isdisjoint(claim) for claim in foreign)
        + other
        + (0 if empty or not said.none else found.total())
    )


def dilute(truth: dict[str, Any], said: Said) -> float:
    """What remains of the credit beside many claims that nobody can judge."""
    kind = {name for effect in truth["effects"] for name in (effect["name"], *effect["same_as"])}
    spared = [one.name for one in said.effects if one.name in truth["tolerated"] and one.name not in kind]
    groups = [
        one for one in said.undecided if kind.isdisjoint(one) and not {*one}.isdisjoint(truth["tolerated"])
    ]
    return min(1.0, 4.0 / (len(spared) + len(groups) or 1))


def judge(truth: dict[str, Any], said: Said) -> dict[str, Any]:
    """What one task adds to every score."""
    credit, found = count_found(truth, said)
    false = count_false(truth, said, found)
    count = found.total()
    empty = not truth["effects"] and not truth["unlisted"]
    tally = {
        "right": found["right"],
        "undecided": found["undecided"],
        "wrong" if false else "abstained": found["left"],
    }
    row: dict[str, Any] = {
        kind: [1.0] * tally.get(kind, 0) + [0.0] * (count - tally.get(kind, 0))
        for kind in ("right", "undecided", "abstained", "wrong")
    }
    row |= {
        "points": [max(-1.0, (credit * dilute(truth, said) - false) / count)],
        "false_in_empty": [false] if empty else [],
        "cpu_s": [] if said.cpu_s is None else [said.cpu_s],
    }
    return row | judge_numbers(truth, said) | judge_motion(truth["held_out"], said)


def judge_numbers(truth: dict[str, Any], said: Said) -> dict[str, Any]:
    """Intervals of numbers of effects that were named by their own name."""
    told = {(one.name, key): number for one in said.effects for key, number in one.parameters.items()}
    pairs = [
        (told[effect["name"], key], true)
        for effect in truth["effects"]
        for key, true in effect["parameters"].items()
        if (effect["name"], key) in told and true["value"] is not None
    ]
    ends = [(one.low, one.high, true) for one, true in pairs if one.low is not None and one.high is not None]
    return {
        "coverage": [float(low <= true["value"] <= high) for low, high, true in ends],
        "width": [(high - low) / true["scale"] for low, high, true in ends if true["scale"]],
    }


def judge_motion(held: dict[str, Any], said: Said) -> dict[str, Any]:
    """Errors at the ends of windows over those of the true physics and of the ideal model."""
    mine = dict(held["ideal"])
    if said.poses is not None:
        pairs = list(zip(said.poses, held["poses"], strict=True))
        squares = [(a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 for a, b in pairs]
        turns = [math.remainder(a[2] - b[2], math.tau) ** 2 for a, b in pairs]
        mine = {
            "position_m": math.sqrt(statistics.fmean(squares)),
            "yaw_rad": math.sqrt(statistics.fmean(turns)),
        }
    row = {}
    for name, key in (("position", "position_m"), ("yaw", "yaw_rad")):
        for beside in ("floor", "ideal"):
            by = held[beside]
            row[f"{name}_over_{beside}"] = [] if by is None else [max(mine[key], 1e-6) / max(by[key], 1e-6)]
    return row


def pool(name: str, rows: list[dict[str, Any]]) -> float:
    """One score over tasks."""
    values = [value for row in rows for value in row[name]]
    if not values:
        return NAN
    if name in {"width", "cpu_s"}:
        return statistics.median(values)
    return statistics.geometric_mean(values) if "_over_" in name else statistics.fmean(values)


def score(rows: list[dict[str, Any]], resamples: int = 2000) -> dict[str, tuple[float, float, float]]:
    """Every score with its interval by resampling tasks."""
    dice, scores = random.Random(5), {}  # noqa: S311 - for a test
    draws = [dice.choices(rows, k=len(rows)) for _ in range(resamples)]
    for name in rows[0]:
        spread = sorted(value for draw in draws if not math.isnan(value := pool(name, draw)))
        ends = statistics.quantiles(spread, n=40, method="inclusive") if len(spread) > 1 else [NAN] * 39
        scores[name] = (pool(name, rows), ends[0], ends[-1])
    return scores
