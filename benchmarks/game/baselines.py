"""Peers of `slip` in the game that need nothing of it: numpy, scipy and mcap-ros2-support.

nothing         says that nothing is hidden; the ideal model predicts
full_linear     body velocity = matrix x commands (Baril et al. 2020); predicts, and names nothing
sparse          sparse regression over a library of 13 terms of the body velocity (sequentially thresholded
                least squares, Brunton et al. 2016); a term that stays names its effect
icr_asymmetric  three centres of rotation and two speed factors (Mandow et al. 2007); names what of them
                is not at its neutral value
"""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from game.read_task import Read, list_tasks, predict_windows, read_task, walk_velocities
from game.score import ANSWER_FORMAT

Floats = NDArray[np.float64]
Json = dict[str, Any]

_CELL_S = 0.05
_SPAN_S = 0.5  # long enough that the noise of poses leaves a velocity to within a few mm/s
_SURE = 1.96
_LEAST_T = 5.0  # of a term that stays: residuals of neighbouring spans are alike, and t is too large by that
_LEAST_SHARE = 0.01  # of the squared velocity of its channel that a term must explain to be named


def drive_ideally(read: Read) -> tuple[Floats, Floats]:
    """Edges of cells [s] and the ideal body velocity (v_x, v_y, v_w) in each, from the commands."""
    edges = np.arange(0.0, max(read.windows[-1, 4], read.poses[-1, 0]) + _CELL_S, _CELL_S)
    at = np.searchsorted(read.commands[:, 0], 0.5 * (edges[:-1] + edges[1:]), side="right") - 1
    speed, turn = np.where(at[:, None] >= 0, read.commands[np.maximum(at, 0), 1:], 0.0).T
    if read.is_car:
        turn = speed * np.tan(turn) / read.sheet["wheelbase_m"]
    return edges, np.column_stack((speed, np.zeros_like(speed), turn))


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


Term = tuple[int, Callable[[Floats], Floats], str, str, Callable[[float], float]]


def list_terms(*, is_car: bool) -> list[Term]:
    """Channel, column of (v, s, w), name (none: no effect fits), parameter, its value by coefficient."""
    turning = (
        (2, lambda b: b[2], "steering_gain", "g", lambda c: 1.0 + c)
        if is_car
        else (2, lambda b: b[2], "effective_track", "k", lambda c: 1.0 / max(1.0 + c, 0.05))
    )
    terms: list[Term] = [
        (0, lambda b: b[0], "wheel_radius", "k", lambda c: 1.0 + c),
        (0, lambda b: b[0] * abs(b[0]), "speed_slip", "k", lambda c: -c),
        (0, lambda b: b[0] * abs(b[2]), "turning_resistance", "k", lambda c: -c),
        (0, lambda b: np.minimum(b[0], 0.0), "", "", lambda c: -c),
        (0, lambda b: b[2], "icr_lateral", "y_icr", lambda c: c),
        (1, lambda b: b[0] * b[2], "lateral_skid", "c", lambda c: -c),
        (1, lambda b: b[2], "icr_offset", "x_icr", lambda c: -c),
        (1, lambda b: b[0], "yaw_misalignment", "psi", lambda c: -c),
        (1, lambda b: np.sign(abs(b).sum(axis=0)), "lateral_drift", "c", lambda c: c),
        turning,
        (2, lambda b: abs(b[0]) * b[2], "speed_track", "k", lambda c: c),
        (2, lambda b: np.minimum(b[2], 0.0), "", "", lambda c: -c),
        (2, lambda b: np.sign(abs(b).sum(axis=0)), "yaw_drift", "c", lambda c: c),
    ]
    return terms


def answer_sparse(read: Read) -> Json:
    edges, ideal = drive_ideally(read)
    mean, measured = measure_velocity(read, edges, ideal)
    velocity, effects, unnamed = ideal.copy(), [], set[str]()
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
            if not name:
                unnamed.add("xyw"[channel])
                continue
            ends = sorted(convert(float(end)) for end in (value - _SURE * error, value + _SURE * error))
            number = {"value": convert(float(value)), "low": ends[0], "high": ends[1]}
            effects.append({"name": name, "parameters": {parameter: number}})
    poses = predict_windows(read, edges, walk_velocities(edges, velocity))
    other = {"other": {"channels": sorted(unnamed)}} if unnamed else {}
    return {"effects": effects, "none": not effects and not unnamed, "poses": poses, **other}


def answer_full_linear(read: Read) -> Json:
    edges, ideal = drive_ideally(read)
    mean, measured = measure_velocity(read, edges, ideal)
    matrix = np.linalg.lstsq(mean, measured, rcond=None)[0]
    return {"poses": predict_windows(read, edges, walk_velocities(edges, ideal @ matrix))}


def answer_icr_asymmetric(read: Read) -> Json:
    if read.is_car:
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
        ("wheel_radius", "k", 1.0, [0.5, 0.5, 0.0, 0.0, 0.0]),
        ("wheel_asymmetry", "e", 0.0, [-1.0, 1.0, 0.0, 0.0, 0.0]),
        ("effective_track", "k", 1.0, [0.0, 0.0, 0.5 / half, -0.5 / half, 0.0]),
        ("icr_lateral", "y_icr", 0.0, [0.0, 0.0, 0.5, 0.5, 0.0]),
        ("icr_offset", "x_icr", 0.0, [0.0, 0.0, 0.0, 0.0, 1.0]),
    ):
        row = np.array(weights)
        value, error = float(row @ fit.x), float(np.sqrt(row @ covariance @ row))
        if abs(value - neutral) > max(_LEAST_T * error, 0.02):
            effects.append({"name": name, "parameters": {parameter: tell(value, error)}})
    poses = predict_windows(read, edges, walk_velocities(edges, move(fit.x, ideal)))
    return {"effects": effects, "none": not effects, "poses": poses}


BASELINES: dict[str, Callable[[Read], Json]] = {
    "nothing": answer_nothing,
    "sparse": answer_sparse,
    "full_linear": answer_full_linear,
    "icr_asymmetric": answer_icr_asymmetric,
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
        content = {"format": ANSWER_FORMAT, "task": read.id, **said, **spent}
        (out / f"{read.id}.json").write_text(json.dumps(content, allow_nan=False) + "\n", encoding="utf-8")
    return len(folders)
