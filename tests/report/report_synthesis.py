"""Tables of a made-up run that keep the contracts: command steps, a lagging skid-steer vehicle, gaps."""

from __future__ import annotations

import re

import numpy as np
import polars as pl
from numpy.typing import NDArray

from pipeline.core.untrusted import mapping_in, objects_in
from pipeline.estimation.effect_signature import SINCE_STEP, Signature
from pipeline.estimation.verdict import format_verdict
from pipeline.report.figures import list_figures
from pipeline.report.motion_view import MotionView
from pipeline.report.scene import RunReport
from schemas import contract_of

RATE_HZ = 20.0
STEP_S = 6.0
START_NS = 1_725_000_000_000_000_000

Floats = NDArray[np.float64]


def make_report(
    *, duration_s: float = 60.0, seed: int = 1, measured: bool = True, names: dict[str, str] | None = None
) -> RunReport:
    """A run of so many seconds; ``names`` replaces texts of the summary and the identity columns."""
    tables = make_tables(duration_s=duration_s, seed=seed, measured=measured, names=names or {})
    tables["power"] = make_power(duration_s)
    return RunReport(
        make_summary(tables, names or {}), tables, make_diagnosis(names or {}), make_motion(tables)
    )


def make_power(duration_s: float) -> pl.DataFrame:
    """Current and energy per distance, once a second."""
    t = np.arange(0.0, duration_s)
    wave = np.sin(0.3 * t)
    return pl.DataFrame({"t": t, "current": 15.0 + 10.0 * wave, "energy_per_m": 450.0 + 200.0 * wave})


def make_diagnosis(names: dict[str, str]) -> dict[str, object]:
    """The JSON object of a diagnosis of that run."""
    sizes = ((1.06, 0.96), (0.44, 0.13), (0.31, 0.10))
    effects = ["effective_track", "drive_lag"]
    content: dict[str, object] = {
        "run": names.get("run", "field/2026-11-02_warthog"),
        "input": "command",
        "effects": [
            {
                "id": "effective_track",
                "parameters": {"k": {"value": 1.79, "low": 1.74, "high": 1.84, "unit": "1"}},
                "gain": 12.4,
                "equivalent_to": [],
                "confused_with": ["wheel_radius"],
                "clause": "turns at 56 % of the ideal rate",
                "sentence": "Effective track 1.93 m (nominal 1.08): the robot turns at 56 % of the ideal "
                "rate. Cause: skidding or a wrong track width; a run on another surface separates them.",
                "growth": make_growth("k", 0.05),
            },
            {
                "id": "drive_lag",
                "parameters": {"tau": {"value": 1.08, "low": 1.01, "high": 1.15, "unit": "s"}},
                "gain": 0.31,
                "found_on": "wheels",
                "equivalent_to": ["body_inertia"],
                "clause": "follows commands with a time constant of 1.1 s",
                "growth": make_growth("tau", 0.07),
            },
        ],
        "undecided": [
            {
                "candidates": ["lateral_skid", "icr_offset"],
                "separate_by": names.get("advice", "drive circles"),
            }
        ],
        "unobservable": ["slope_drift"],
        "where": [
            {
                "region": "turning faster than 1 rad/s",
                "text": "turning faster than 1 rad/s: 74 % of the yaw error in 21 % of the time",
            }
        ],
        "when": [
            {
                "quantity": "heading",
                "time_share": 0.05,
                "spans": [{"t_start": 12.0, "t_end": 16.0, "share": 0.3, "text": "12 to 16 s (30 %)"}],
                "text": "half of the remaining squared heading error over 2 s arises in 5 % of the time; "
                "largest parts: 12 to 16 s (30 %)",
            }
        ],
        "unexplained": None,
        "findings": [],
        "ladder": [
            {"effects": effects[:count], "t_mrmse_m": t, "r_mrmse_rad": r}
            for count, (t, r) in enumerate(sizes)
        ],
        "noise_floor": {"t_mrmse_m": 0.19, "r_mrmse_rad": 0.07},
        "explained_share": 0.86,
        "budget": [make_budget("slip", 1.87), make_budget("position", 1.12)],
        "enough": "effective_track.k known to 5 % after 20 s of 90 s",
    }
    return {**content, "verdict": format_verdict(content)}


def make_growth(name: str, last: float) -> dict[str, object]:
    """Curves that begin without an interval and narrow with the square root of the time."""
    seconds = [10.0 * count for count in range(1, 10)]
    halves = [None, *(last * (90.0 / second) ** 0.5 for second in seconds[1:])]
    return {
        "evidence": {"seconds": seconds, "t": [0.1 * second for second in seconds]},
        "parameters": {name: {"seconds": seconds, "half_width": halves}},
    }


def make_budget(quantity: str, total: float) -> dict[str, object]:
    """A budget whose second effect makes held-out data worse."""
    shares = {"effective_track": 0.85, "drive_lag": -0.05}
    return {
        "input": "command",
        "quantity": quantity,
        "total": total,
        "shares": [
            {"effect": name, "share": share, "low": share - 0.03, "high": share + 0.03}
            for name, share in shares.items()
        ],
        "disturbance": {"share": 0.15, "low": 0.12, "high": 0.18},
        "localization_noise": {"share": 0.05, "low": None, "high": None},
    }


def make_motion(tables: dict[str, pl.DataFrame]) -> MotionView:
    """A model that takes most of the ideal one's residuals."""
    slip = tables["slip"].filter(pl.col("input") == "command").gather_every(5)
    t, piece = slip["t"].to_numpy(), slip["segment"].to_numpy()
    ideal = {f"ideal_{axis}": -slip[f"g_{axis}"].to_numpy() for axis in "xyw"}
    model = {f"model_{axis}": 0.2 * -slip[f"g_{axis}"].to_numpy() for axis in "xyw"}
    f_x, f_w = slip["f_x"].to_numpy(), slip["f_w"].to_numpy()
    rates = {"a_x": np.gradient(f_x), "a_w": np.gradient(f_w)}
    flat = {"roll": np.zeros(t.size), "pitch": np.zeros(t.size)}
    signals = {"f_x": f_x, "f_y": 0.0 * f_x, "f_w": f_w, "f_x_f_w": f_x * f_w, **rates, **flat}
    velocity = {f"v_{axis}": slip[f"v_{axis}"].to_numpy() + model[f"model_{axis}"] for axis in "xyw"}
    size = slip["modulus"].to_numpy()
    track = tables["velocities"].gather_every(40).select("t", "x", "y")
    diagnosis = make_diagnosis({})
    return MotionView(
        input="command",
        effects=("drive_lag", "effective_track"),
        ladder=objects_in(diagnosis, "ladder"),
        floor=mapping_in(diagnosis, "noise_floor"),
        residuals=pl.DataFrame({"t": t, **ideal, **model, **signals}),
        velocity=pl.DataFrame({"t": t, "piece": piece, **velocity}),
        horizon_errors=pl.DataFrame(
            {
                "t": t,
                "piece": piece,
                "ideal": size,
                "model": 0.3 * size,
                "ideal_yaw": size,
                "model_yaw": 0.1 * size,
            }
        ),
        arcs=track.with_columns(piece=pl.int_range(pl.len()) // 4),
        signatures=[
            make_signature("effective_track", "w", "f_w"),
            make_signature("drive_lag", "x", SINCE_STEP),
        ],
    )


def join_commands(page: str) -> str:
    """A page whose commands are one text each: on the page names of options are elements of their own."""
    return re.sub(r'<span class="option">([^<]*)</span>', r"\1", page)


def list_places() -> list[str]:
    """Ids of the figures of a page of that run, in its order: one a named effect, one for every other."""
    found: list[str] = []
    for figure in list_figures():
        found += (
            [f"signature-{name}" for name in ("effective_track", "drive_lag")]
            if figure.panels
            else [figure.id]
        )
    return found


def make_signature(effect: str, channel: str, variable: str) -> Signature:
    """A curve that the points lie on."""
    value = np.linspace(-1.0, 1.0, 9)
    error = np.full(9, 0.02)
    return Signature(
        effect, channel, variable, 0.97, value, -0.4 * value, -0.4 * value, error, 0.0 * value, error
    )


def make_tables(
    *, duration_s: float, seed: int, measured: bool, names: dict[str, str]
) -> dict[str, pl.DataFrame]:
    """All tables, each validated against its contract."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(duration_s * RATE_HZ)) / RATE_HZ
    t = t[(t < 0.4 * duration_s) | (t > 0.4 * duration_s + 3.0)]
    segment = (t > 0.4 * duration_s).astype(np.int32)
    step = (t // STEP_S).astype(np.int32)
    steps = int(step.max()) + 1
    asked = np.column_stack((rng.uniform(-1.0, 4.0, steps), np.zeros(steps), rng.uniform(-1.6, 1.6, steps)))
    command = asked[step]
    wheels = _lag(command, 0.8)
    body = _lag(wheels, 0.2) * np.array([0.96, 0.0, 0.56]) + rng.normal(0.0, 0.03, (t.size, 3))
    body[:, 1] -= 0.05 * body[:, 0] * body[:, 2]
    body[100, 1] += 9.0  # a lone peak, as a jumping localization makes it
    yaw = np.cumsum(body[:, 2]) / RATE_HZ
    x = np.cumsum(body[:, 0] * np.cos(yaw) - body[:, 1] * np.sin(yaw)) / RATE_HZ
    y = np.cumsum(body[:, 0] * np.sin(yaw) + body[:, 1] * np.cos(yaw)) / RATE_HZ
    stamp = START_NS + np.round(t * 1e9).astype(np.int64)
    identity = {
        "run": names.get("run", "field/2026-11-02_warthog"),
        "dataset": names.get("dataset", "warthog_gravel"),
        "vehicle": names.get("vehicle", "warthog"),
        "terrain": names.get("terrain", "gravel"),
    }
    grid = {"t": t, "stamp": stamp, "segment": segment}
    zero = np.zeros(t.size)
    velocity = {"v_x": body[:, 0], "v_y": body[:, 1], "v_w": body[:, 2]}
    pose = {"x": x, "y": y, "z": zero, "roll": zero, "pitch": zero, "yaw": yaw}
    whole = {"v_w_imu": body[:, 2], "outlier": np.zeros(t.size, dtype=bool)}
    velocities = _frame(identity, {**grid, **pose, **velocity, **whole})
    ideal = {"command": command} | ({"measured": wheels} if measured else {})
    slip = pl.concat([_slip(identity, grid, name, f, body) for name, f in ideal.items()])
    tables = {
        "velocities": velocities,
        "slip": slip,
        "windows": _windows(slip),
        "aggregates": _aggregates(slip, command - wheels, wheels - body, measured=measured),
        "findings": _findings(identity, names),
    }
    return {name: contract_of(name).schema.validate(frame, cast=True) for name, frame in tables.items()}


def make_summary(tables: dict[str, pl.DataFrame], names: dict[str, str]) -> dict[str, object]:
    """The JSON object that goes with the tables."""
    rows = tables["aggregates"].to_dicts()
    overall = {row["input"]: row for row in rows if row["subset"] == "all"}
    part = {(row["input"], row["subset"]): row["median_modulus"] for row in rows}
    by_input = {
        name: {
            "samples": row["samples"],
            "median_modulus": row["median_modulus"],
            "median_window_norm": row["median_window_norm"],
            "rms": [row["rms_x"], row["rms_y"], row["rms_w"]],
            "transitory_median_modulus": part[name, "transitory"],
            "steady_median_modulus": part[name, "steady"],
        }
        for name, row in overall.items()
    }
    command = overall["command"]
    split = None
    if command["drivetrain_mean_square"] is not None:
        kinds = ("drivetrain", "ground", "cross")
        split = {kind: command[f"{kind}_mean_square"] / command["mean_square"] for kind in kinds}
    slip = tables["slip"]
    return {
        "run": slip["run"][0],
        "log": {
            "path": names.get("path", "logs/2026-11-02_warthog.mcap"),
            "sha256": "5d" * 32,
            "duration_s": float(slip["t"].max()),  # type: ignore[arg-type]
            "complete": False,
            "losses": [{"kind": "chunk_crc", "bytes": 48231, "chunks": 1, "start_s": 24.0, "end_s": 27.0}],
        },
        "vehicle": slip["vehicle"][0],
        "terrain": slip["terrain"][0],
        "dataset": slip["dataset"][0],
        "input": "both",
        "rate_hz": RATE_HZ,
        "samples": command["samples"],
        "segments": 2,
        "median_modulus": command["median_modulus"],
        "median_window_norm": command["median_window_norm"],
        "length_scale_m": 1.0,
        "by_input": by_input,
        "split": split,
        "held_poses": 0.52,
        "quarantined": {"poses": {"rows": 3, "rules": {"quaternion_has_unit_length": 3}}},
        "distance_m": 1421.0,
        "findings": [
            {key: row[key] for key in ("id", "severity", "text", "where", "t_start", "t_end")}
            for row in tables["findings"].to_dicts()
        ],
        "topics": {
            "command": {"topic": names.get("topic", "/cmd_vel"), "reason": "what the controller received"},
            "wheels": {"topic": "/joint_states", "reason": "four wheel joints by name"},
            "pose": {
                "topic": "/mapping/icp_odom",
                "reason": "the only localization that is no wheel odometry",
            },
            "imu": {"topic": None, "reason": names.get("reason", "no IMU in the log")},
        },
        "provenance": {
            "versions": {"slip": "0.1.0"},
            "keys": {"slip": "9c1f2a"},
            "configuration": {"run": {"terrain": slip["terrain"][0]}, "velocity": {"rate_hz": 20}},
        },
    }


def _lag(target: Floats, tau: float) -> Floats:
    reached = np.zeros_like(target)
    gain = 1.0 - np.exp(-1.0 / (RATE_HZ * tau))
    for i in range(1, len(target)):
        reached[i] = reached[i - 1] + gain * (target[i] - reached[i - 1])
    return reached


def _frame(identity: dict[str, str], columns: dict[str, object]) -> pl.DataFrame:
    return pl.DataFrame(columns).with_columns(**{name: pl.lit(text) for name, text in identity.items()})


def _slip(
    identity: dict[str, str],
    grid: dict[str, object],
    name: str,
    ideal: Floats,
    body: Floats,
) -> pl.DataFrame:
    gap = ideal - body
    t = np.asarray(grid["t"])
    step = (t // STEP_S).astype(np.int32)
    parts: dict[str, object] = {"step": step, "transitory": (t % STEP_S) < 2.0}
    for i, axis in enumerate("xyw"):
        parts |= {f"f_{axis}": ideal[:, i], f"v_{axis}": body[:, i], f"g_{axis}": gap[:, i]}
    parts["modulus"] = np.linalg.norm(gap, axis=1)
    parts["suspect"] = (step == 1) & ((t % STEP_S) > 4.5)
    names = ("model_x", "model_y", "model_w", "residual_modulus")
    model = [pl.lit(None, pl.Float64).alias(column) for column in names]
    return _frame(identity, {**grid, **parts}).with_columns(*model, input=pl.lit(name))


def _windows(slip: pl.DataFrame) -> pl.DataFrame:
    square = (pl.col("modulus") ** 2).mean()
    keys = ["run", "dataset", "vehicle", "terrain", "input", "segment", "step"]
    return (
        slip.with_columns(window=(pl.col("t") % STEP_S // 2.0))
        .group_by(*keys, "window", maintain_order=True)
        .agg(
            t_start=pl.col("t").min(),
            t_end=pl.col("t").max(),
            transitory=pl.col("transitory").first(),
            suspect=pl.col("suspect").any(),
            samples=pl.len().cast(pl.Int32),
            rms_modulus=square.sqrt(),
            window_norm=square.sqrt() * np.sqrt(40.0),
        )
        .drop("window")
    )


def _aggregates(slip: pl.DataFrame, drive: Floats, ground: Floats, *, measured: bool) -> pl.DataFrame:
    rows = []
    for (name,), frame in slip.group_by("input", maintain_order=True):
        late = frame["transitory"].to_numpy()
        for subset, chosen in (("all", late | True), ("transitory", late), ("steady", ~late)):
            part = frame.filter(chosen)
            split = measured and name == "command"
            rows.append(
                {key: frame[key][0] for key in ("run", "dataset", "vehicle", "terrain")}
                | {"input": name, "subset": subset, "samples": part.height, "windows": part.height // 40}
                | {"median_modulus": part["modulus"].median()}
                | {"median_window_norm": 6.3 * (part["modulus"] ** 2).mean() ** 0.5}
                | {f"rms_{axis}": (part[f"g_{axis}"] ** 2).mean() ** 0.5 for axis in "xyw"}
                | {"mean_square": (part["modulus"] ** 2).mean()}
                | {
                    "drivetrain_mean_square": float((drive[chosen] ** 2).sum(axis=1).mean())
                    if split
                    else None
                }
                | {"ground_mean_square": float((ground[chosen] ** 2).sum(axis=1).mean()) if split else None}
                | {
                    "cross_mean_square": float(2 * (drive * ground)[chosen].sum(axis=1).mean())
                    if split
                    else None
                }
                | {"distance": 1421.0, "duration": part.height / RATE_HZ, "height_rate": 0.1}
                | {"largest_kinetic_energy": 3100.0, "length_scale": 1.0, "median_residual_modulus": None}
            )
    return pl.DataFrame(rows)


def _findings(identity: dict[str, str], names: dict[str, str]) -> pl.DataFrame:
    rows = [
        (
            "extract",
            "held_poses",
            "info",
            "52 % of the poses repeat the one before: a slow ICP sampled at 20 Hz",
        ),
        ("extract", "imu_sign", "warning", names.get("finding", "The IMU's yaw rate has the opposite sign.")),
        ("velocity", "pose_jump", "info", "1 jump of the pose: a correction of the map, not a motion"),
    ]
    frame = pl.DataFrame(rows, schema=["stage", "id", "severity", "text"], orient="row")
    return frame.with_columns(
        **{name: pl.lit(text) for name, text in identity.items()},
        where=pl.lit(names.get("where", "/imu/data")),
        t_start=pl.lit(24.0),
        t_end=pl.lit(27.0),
        value=pl.lit(0.5),
        count=pl.lit(1),
    )
