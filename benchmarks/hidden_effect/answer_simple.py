"""Baselines of HiddenEffect that need nothing of this project: numpy, scipy and mcap-ros2-support.

    python benchmarks/hidden_effect/answer_simple.py RINGS/open --baseline sparse --out answers/sparse

nothing          says that nothing is hidden; the ideal model predicts
effective_track  always names effective_track, and fits it
sparse           sparse regression over a library of 14 terms of the body velocity (sequentially thresholded
                 least squares, Brunton et al. 2016); a term that stays names its effect
full_linear      body velocity = matrix x wheel speeds (Baril et al. 2020); predicts, and names nothing
icr_asymmetric   three centres of rotation and two speed factors (Mandow et al. 2007); names what of them
                 is not at its neutral value
bicycle_understeer  a car with an understeer gradient; on other vehicles it abstains
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from read_task import Read, list_tasks, predict_windows, read_task, walk_velocities
from scipy.optimize import least_squares

Floats = NDArray[np.float64]
Json = dict[str, Any]

FORMAT = "hidden-effect-answer/1"
_CELL_S = 0.05
_SPAN_S = 0.5  # long enough that the noise of poses leaves a velocity to within a few mm/s
_SURE = 1.96
_LEAST_T = 5.0  # of a term that stays: residuals of neighbouring spans are alike, and t is too large by that
_LEAST_SHARE = 0.01  # of the squared velocity of its channel that a term must explain to be named


def drive_ideally(read: Read) -> tuple[Floats, Floats]:
    """Edges of cells [s] and the ideal body velocity (v_x, v_y, v_w) in each, from the commands."""
    edges = np.arange(0.0, max(read.windows[-1, 4], read.poses[-1, 0]) + _CELL_S, _CELL_S)
    at = np.searchsorted(read.commands[:, 0], 0.5 * (edges[:-1] + edges[1:]), side="right") - 1
    speed, aside, turn = np.where(at[:, None] >= 0, read.commands[np.maximum(at, 0), 1:], 0.0).T
    if read.is_car:
        turn = speed * np.tan(turn) / read.sheet["wheelbase_m"]
    return edges, np.column_stack((speed, aside, turn))


def measure_velocity(read: Read, edges: Floats, ideal: Floats) -> tuple[Floats, Floats]:
    """Ideal and measured body velocity over spans of poses, each of shape (n, 3).

    Spans over a hole or a jump of the localization are left out.
    """
    every = max(round(_SPAN_S / float(np.median(np.diff(read.poses[:, 0])))), 1)
    first, last = read.poses[:-every:every], read.poses[every::every]
    count = min(len(first), len(last))
    first, last = first[:count], last[:count]
    step = last[:, 0] - first[:, 0]
    middle = 0.5 * (first[:, 3] + last[:, 3])
    moved = ((last[:, 1] - first[:, 1]) + 1j * (last[:, 2] - first[:, 2])) * np.exp(-1j * middle)
    measured = np.column_stack((moved.real, moved.imag, last[:, 3] - first[:, 3])) / step[:, None]
    sums = np.vstack((np.zeros(3), np.cumsum(ideal * np.diff(edges)[:, None], axis=0)))
    mean = (
        np.column_stack(
            [np.interp(last[:, 0], edges, one) - np.interp(first[:, 0], edges, one) for one in sums.T]
        )
        / step[:, None]
    )
    fits = np.abs(step - np.median(step)) < 0.5 * _SPAN_S
    away = np.abs(measured - mean)
    fits &= (away < 10.0 * np.median(away, axis=0) + 0.3).all(axis=1)
    return mean[fits], measured[fits]


def solve(columns: Floats, target: Floats) -> tuple[Floats, Floats]:
    """Least squares and standard errors, which count neighbouring residuals that are alike once."""
    found = np.linalg.lstsq(columns, target, rcond=None)[0]
    rest = target - columns @ found
    alike = np.corrcoef(rest[:-1], rest[1:])[0, 1] if rest.std() > 0.0 else 0.0
    inflation = (1.0 + max(alike, 0.0)) / max(1.0 - max(alike, 0.0), 0.05)
    variance = rest @ rest / max(len(rest) - columns.shape[1], 1) * inflation
    return found, np.sqrt(np.diag(np.linalg.pinv(columns.T @ columns)) * variance)


def tell(value: float, error: float) -> Json:
    """A number with its 95 % interval."""
    return {"value": value, "low": value - _SURE * error, "high": value + _SURE * error}


def answer_nothing(read: Read) -> Json:
    edges, ideal = drive_ideally(read)
    return {"none": True, "poses": predict_windows(read, edges, walk_velocities(edges, ideal))}


def answer_effective_track(read: Read) -> Json:
    edges, ideal = drive_ideally(read)
    mean, measured = measure_velocity(read, edges, ideal)
    gain, error = solve(mean[:, 2:], measured[:, 2])
    k, spread = 1.0 / gain[0], error[0] / gain[0] ** 2
    poses = walk_velocities(edges, ideal * [1.0, 1.0, gain[0]])
    effects = [{"name": "effective_track", "parameters": {"k": tell(float(k), float(spread))}}]
    return {"effects": effects, "poses": predict_windows(read, edges, poses)}


Term = tuple[int, Callable[[Floats], Floats], str, str, Callable[[float], float]]


def list_terms(*, is_car: bool) -> list[Term]:
    """Channel, column of (v, s, w), name, parameter and its value by the coefficient."""
    turning = (
        (2, lambda b: b[2], "steering_gain", "g", lambda c: 1.0 + c)
        if is_car
        else (2, lambda b: b[2], "effective_track", "k", lambda c: 1.0 / max(1.0 + c, 0.05))
    )
    terms: list[Term] = [
        (0, lambda b: b[0], "wheel_radius_scale", "k", lambda c: 1.0 + c),
        (0, lambda b: b[0] * abs(b[0]), "slip_with_speed", "k", lambda c: -c),
        (0, lambda b: b[0] * abs(b[2]), "slip_in_turns", "k", lambda c: -c),
        (0, lambda b: np.minimum(b[0], 0.0), "slip_in_reverse", "k", lambda c: -c),
        (0, lambda b: b[2], "rotation_centre_left", "y_icr", lambda c: c),
        (1, lambda b: b[1], "sideways_scale", "k", lambda c: 1.0 + c),
        (1, lambda b: b[0] * b[2], "outward_skid", "c", lambda c: -c),
        (1, lambda b: b[2], "rotation_centre_forward", "x_icr", lambda c: -c),
        (1, lambda b: b[0], "heading_misalignment", "psi", lambda c: -c),
        (1, lambda b: np.sign(abs(b).sum(axis=0)), "sideways_drift", "c", lambda c: c),
        turning,
        (2, lambda b: abs(b[0]) * b[2], "turn_gain_with_speed", "k", lambda c: c),
        (2, lambda b: np.minimum(b[2], 0.0), "one_sided_turn_loss", "k", lambda c: -c),
        (2, lambda b: np.sign(abs(b).sum(axis=0)), "yaw_rate_bias", "c", lambda c: c),
    ]
    return terms


def answer_sparse(read: Read) -> Json:
    edges, ideal = drive_ideally(read)
    mean, measured = measure_velocity(read, edges, ideal)
    velocity, effects = ideal.copy(), []
    for channel in range(3):
        terms = [term for term in list_terms(is_car=read.is_car) if term[0] == channel]
        columns = np.column_stack([term[1](mean.T) for term in terms])
        target = measured[:, channel] - mean[:, channel]
        kept = [place for place in range(len(terms)) if columns[:, place].any()]
        while kept:
            found, errors = solve(columns[:, kept], target)
            t = np.abs(found) / np.maximum(errors, 1e-12)
            share = (found * columns[:, kept].std(axis=0)) ** 2 / max(float(measured[:, channel].var()), 1e-9)
            weak = np.flatnonzero((t < _LEAST_T) | (share < _LEAST_SHARE))
            if weak.size == 0:
                break
            del kept[weak[np.argmin(t[weak])]]
        for place, value, error in zip(kept, found, errors, strict=True) if kept else ():
            _, column, name, parameter, convert = terms[place]
            velocity[:, channel] += value * column(ideal.T)
            ends = sorted(convert(float(end)) for end in (value - _SURE * error, value + _SURE * error))
            number = {"value": convert(float(value)), "low": ends[0], "high": ends[1]}
            effects.append({"name": name, "parameters": {parameter: number}})
    poses = predict_windows(read, edges, walk_velocities(edges, velocity))
    return {"effects": effects, "none": not effects, "poses": poses}


def answer_full_linear(read: Read) -> Json:
    edges, ideal = drive_ideally(read)
    mean, measured = measure_velocity(read, edges, ideal)
    matrix = np.linalg.lstsq(mean, measured, rcond=None)[0]
    return {"poses": predict_windows(read, edges, walk_velocities(edges, ideal @ matrix))}


def answer_icr_asymmetric(read: Read) -> Json:
    if read.is_car or read.sheet["kind"] == "mecanum":
        return {}
    half = 0.5 * read.sheet["track_width_m"]
    edges, ideal = drive_ideally(read)
    mean, measured = measure_velocity(read, edges, ideal)
    noise = np.maximum((measured - mean).std(axis=0), 1e-6)

    def move(values: Floats, body: Floats) -> Floats:
        scale_left, scale_right, y_left, y_right, x = values
        left = scale_left * (body[:, 0] - half * body[:, 2])
        right = scale_right * (body[:, 0] + half * body[:, 2])
        turn = (right - left) / (y_left - y_right)
        return np.column_stack(((right * y_left - left * y_right) / (y_left - y_right), -x * turn, turn))

    fit = least_squares(
        lambda values: ((move(values, mean) - measured) / noise).ravel(),
        np.array([1.0, 1.0, half, -half, 0.0]),
        bounds=([0.2, 0.2, 0.2 * half, -10.0 * half, -2.0], [3.0, 3.0, 10.0 * half, -0.2 * half, 2.0]),
    )
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac) * 2.0 * fit.cost / fit.fun.size
    effects = []
    for name, parameter, neutral, weights in (
        ("wheel_radius_scale", "k", 1.0, [0.5, 0.5, 0.0, 0.0, 0.0]),
        ("wheel_radius_difference", "e", 0.0, [-1.0, 1.0, 0.0, 0.0, 0.0]),
        ("effective_track", "k", 1.0, [0.0, 0.0, 0.5 / half, -0.5 / half, 0.0]),
        ("rotation_centre_left", "y_icr", 0.0, [0.0, 0.0, 0.5, 0.5, 0.0]),
        ("rotation_centre_forward", "x_icr", 0.0, [0.0, 0.0, 0.0, 0.0, 1.0]),
    ):
        row = np.array(weights)
        value, error = float(row @ fit.x), float(np.sqrt(row @ covariance @ row))
        if abs(value - neutral) > max(_LEAST_T * error, 0.02):
            effects.append({"name": name, "parameters": {parameter: tell(value, error)}})
    poses = predict_windows(read, edges, walk_velocities(edges, move(fit.x, ideal)))
    return {"effects": effects, "none": not effects, "poses": poses}


def answer_bicycle_understeer(read: Read) -> Json:
    if not read.is_car:
        return {}
    edges, ideal = drive_ideally(read)
    mean, measured = measure_velocity(read, edges, ideal)
    base = read.sheet["wheelbase_m"]

    def turn(gradient: float, body: Floats) -> Floats:
        return body[:, 2] * base / (base + gradient * body[:, 0] ** 2)

    fit = least_squares(lambda k: turn(k[0], mean) - measured[:, 2], np.array([0.0]), bounds=(-0.01, 1.0))
    error = float(np.sqrt(2.0 * fit.cost / fit.fun.size / max(float((fit.jac**2).sum()), 1e-12)))
    value = float(fit.x[0])
    shown = abs(value) > _LEAST_T * error
    effects = [{"name": "understeer", "parameters": {"K": tell(value, error)}}] if shown else []
    velocity = np.column_stack((ideal[:, :2], turn(value, ideal)))
    poses = predict_windows(read, edges, walk_velocities(edges, velocity))
    return {"effects": effects, "none": not effects, "poses": poses}


BASELINES: dict[str, Callable[[Read], Json]] = {
    "nothing": answer_nothing,
    "effective_track": answer_effective_track,
    "sparse": answer_sparse,
    "full_linear": answer_full_linear,
    "icr_asymmetric": answer_icr_asymmetric,
    "bicycle_understeer": answer_bicycle_understeer,
}


def write_answers(rings: Path, out: Path, solver: Callable[[Read], Json], *, resume: bool = False) -> int:
    """Answer every task below a folder.

    Args:
        rings: folder of one ring or of several.
        out: where the answers are written.
        solver: from a task to what the answer says.
        resume: leave answers that are there.

    Returns:
        How many were answered.
    """
    out.mkdir(parents=True, exist_ok=True)
    done = {path.stem for path in out.glob("*.json")} if resume else set()
    folders = [folder for folder in list_tasks(rings) if folder.name not in done]
    for folder in folders:
        begun = time.process_time()
        read = read_task(folder)
        said = solver(read)
        spent = {"cpu_s": round(time.process_time() - begun, 3)}
        content = {"format": FORMAT, "task": read.id, **said, **spent}
        (out / f"{read.id}.json").write_text(json.dumps(content, allow_nan=False) + "\n", encoding="utf-8")
    return len(folders)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("rings", type=Path)
    parser.add_argument("--baseline", choices=list(BASELINES), required=True)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    print(f"{write_answers(given.rings, given.out, BASELINES[given.baseline])} answers in {given.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
