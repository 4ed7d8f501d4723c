"""Throws odd models, robots' own files and runs at every target of the exports, and reads what is written.

    python tests/fuzz/fuzz_exports.py --minutes 60 [--seed 1] [--finds folder]

A case is a model file with names that were made to break out and numbers of any size, some of them damaged as
text; it is read, written, read again and exported to every target, with a robot's own file that is damaged as
well. Now and then a stored run is exported with such a model for viewers and spreadsheets. Anything but one
clear error, or a file that its own reader reads, with the robot's name in it as data, is a find: another
exception, a warning, a name that runs, a number that is not finite. A case that takes longer than 20 s ends
the run with a traceback. A case that fails is kept in the folder of finds.
"""

import csv
import json
import math
import random
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "fixtures"), str(Path(__file__).parent)]

from exported_texts import HOSTILE, READERS  # noqa: E402 - the repository is put on the path first
from fuzz_texts import FORMULAS, mutate, require_one_line  # noqa: E402
from fuzzing import keep_failure, run_script  # noqa: E402
from mcap.reader import make_reader  # noqa: E402
from mcap_ros2.decoder import DecoderFactory  # noqa: E402

from pipeline.analysis import Options  # noqa: E402
from pipeline.analysis.analyze import analyze_log  # noqa: E402
from pipeline.core import SlipError  # noqa: E402
from pipeline.estimation.stored_diagnosis import read_slip  # noqa: E402
from pipeline.export import export_model, list_targets, read_current  # noqa: E402
from pipeline.models import Model, format_model, format_value, list_effects  # noqa: E402
from pipeline.models.model_file import ModelFile, parse_model  # noqa: E402
from pipeline.report.viewer_files import write_slip_log, write_tables  # noqa: E402
from pipeline.simulate import simulate_case  # noqa: E402
from pipeline.store import Manifest, Store  # noqa: E402

HANG_S = 20
MEMORY = 4 << 30
VIEWERS_EVERY = 40
"""Cases between two exports of a run, which take a hundred times as long as a model's."""
_USUAL, _INSIDE, _ANY = 0.85, 0.98, 0.99
"""Mostly usual numbers, so that the others of a model with an odd one are used."""
MODEL = Path("m.toml")
PRESETS = {
    "husky_a200": "differential",
    "turtlebot3_burger": "differential",
    "ackermann_car": "ackermann",
    "f1tenth": "ackermann",
    "youbot": "mecanum",
}
GEOMETRY = {
    "wheel_radius_m": 0.1,
    "track_width_m": 0.5,
    "wheelbase_m": 0.7,
    "base_to_rear_axle_m": 0.1,
    "mass_kg": 30.0,
    "max_speed_mps": 1.0,
    "max_yaw_rate_radps": 1.0,
    "max_steering_rad": 0.5,
    "controller_track_multiplier": 1.2,
}
EXTREMES = (0.0, -0.0, -1.0, 1e-300, 5e-324, 1e-12, 1e9, 1e12, 1e154, 1e300, -1e300, 1.7976931348623157e308)
OWN_FILES = {
    "px4": "# Vehicle-Id Component-Id Name Value Type\n1\t1\tRO_MAX_THR_SPEED\t2.5\t9\n",
    "vesc": (
        "/**:\n  ros__parameters:\n    speed_to_erpm_gain: 4614.0\n"
        "    steering_angle_to_servo_gain: -1.2135\n    steering_angle_to_servo_offset: 0.5304\n"
    ),
}


def draw_name(rng: random.Random) -> str:
    """A name as nobody should give one."""
    if rng.random() < 0.5:
        name = "".join(rng.choice(HOSTILE) for _ in range(rng.randint(1, 2)))
    else:
        letters = "-'\"\\\n\r\t\0{}<>!#:;%&[]|*` aNx\x1b\x7f\x85\u2028\ufeff\U0001f916"
        name = "".join(rng.choice(letters) for _ in range(rng.randint(1, 24)))
    return name.encode(errors="replace").decode()


def draw_number(rng: random.Random, usual: float, low: float = -1e6, high: float = 1e6) -> float:
    """A usual number within bounds, one of the bounds, one of any size, or none that a robot has."""
    kind = rng.random()
    if kind < _USUAL:
        return min(max(usual * rng.uniform(0.5, 1.5), low), high)
    if kind < _INSIDE:
        return rng.choice((low, high, rng.uniform(max(low, -1e6), min(high, 1e6))))
    if kind < _ANY:
        return rng.choice((1.0, -1.0)) * 10.0 ** rng.uniform(-12.0, 12.0)
    return rng.choice(EXTREMES)


def draw_model(rng: random.Random) -> str:
    """Text of a model file."""
    lines = [f"note = {format_value(draw_name(rng))}", "[vehicle]"]
    preset, kind = rng.choice(list(PRESETS.items()))
    if rng.random() < 0.3:
        lines.append(f'preset = "{preset}"')
        given = rng.sample(list(GEOMETRY), rng.randint(0, 2))
    else:
        lines += [f"name = {format_value(draw_name(rng))}", f'kind = "{kind}"']
        given = [key for key in GEOMETRY if key in list(GEOMETRY)[:3] or rng.random() < 0.5]
    lines += [f"{key} = {draw_number(rng, GEOMETRY[key])!r}" for key in given]
    known = [effect for effect in list_effects() if kind in effect.kinds or rng.random() < 0.002]
    effects = rng.sample(known, rng.choice((0, 1, 2, 5, 12)))
    for effect in effects:
        lines += ["[[effect]]", f'id = "{effect.id}"']
        for one in effect.parameters:
            if rng.random() < 0.8:
                value = draw_number(rng, one.typical, *one.bounds)
                ends = sorted((draw_number(rng, one.typical), draw_number(rng, one.typical)))
                interval = f", low = {ends[0]!r}, high = {ends[1]!r}" if rng.random() < 0.5 else ""
                lines.append(f"{one.name} = {{ value = {value!r}{interval} }}")
    if rng.random() < 0.5:
        bounds = rng.choice(("", ", bounds = [-1, 1]", ", bounds = [-1e300, 1e300]"))
        lines += ["[[effect]]", f'id = "{rng.choice(("wind", "a---", "é--", "x-y"))}"']
        lines += [f'v_y = "{rng.choice(FORMULAS)}"', f"k = {{ value = {draw_number(rng, 0.1)!r}{bounds} }}"]
    if rng.random() < 0.7:
        lines += _draw_fit(rng, [effect.id for effect in effects])
    return "\n".join(lines) + "\n"


def _draw_fit(rng: random.Random, ids: list[str]) -> list[str]:
    source = rng.choice(("command", "measured", draw_name(rng)))
    lines = ["[fit]", f"input = {format_value(source)}", f"{format_value(draw_name(rng))} = 1"]
    if ids:
        lines.append(f"undecided = [[{format_value(rng.choice(ids))}, {format_value(draw_name(rng))}]]")
    for _ in range(rng.randint(0, 2)):
        lines += ["[[fit.runs]]", f"run = {format_value(draw_name(rng))}"]
        lines += [f"driven_speed_mps = {float(draw_number(rng, 1.0))!r}"]
        lines += [f"driven_yaw_rate_radps = {float(draw_number(rng, 1.0))!r}"]
    for _ in range(rng.randint(0, 2)):
        errors = ", ".join(repr(draw_number(rng, 0.1)) for _ in range(3))
        some = ", ".join(format_value(one) for one in ids[: rng.randint(0, len(ids))])
        lines += ["[[fit.ladder]]", f"effects = [{some}]", f"velocity_rms = [{errors}]"]
    return lines


def open_case(text: str) -> ModelFile | None:
    """The model of a case; None if it is refused. Written, it is read again as it was."""
    try:
        file = parse_model(text, MODEL)
        written = format_model(file)
    except SlipError as error:
        require_one_line(error)
        return None
    again = parse_model(written, MODEL)
    if format_model(again) != written:
        raise AssertionError("written again, the model file is another one")
    if again.model.vehicle.name != file.model.vehicle.name:
        raise AssertionError("the name of the robot is another one")
    return again


def check_targets(file: ModelFile, own: dict[str, str], folder: Path, counts: Counter[str]) -> None:
    """Export a model to every target, and read what is written."""
    for target in list_targets():
        try:
            current = None
            if target.read_current is not None:
                path = folder / target.name
                path.write_text(own[target.name], encoding="utf-8")
                current = read_current(path, target.name)
            text = export_model(file, target.name, current)
        except SlipError as error:
            require_one_line(error)
            counts[f"{target.name}: {error.code}"] += 1
            continue
        _, names = READERS[target.name](text)
        if file.model.vehicle.name not in names:
            raise AssertionError(f"{target.name} does not hold the name of the robot as data")
        counts[target.name] += 1


def make_run(folder: Path) -> Manifest:
    """A short run with results."""
    log = simulate_case("husky_tile", out=folder / "a---> ''' {x}.mcap", duration_s=20.0)
    analyze_log(log, Options(out=folder / "results", report=False, diagnosis=False))
    (manifest,) = Store(folder / "results").manifests()
    return manifest


def check_viewers(
    model: Model | None, manifest: Manifest, frame: str, folder: Path, counts: Counter[str]
) -> None:
    """Export a run for viewers and spreadsheets, and read what is written."""
    try:
        slip = read_slip(manifest, None if model is None else ModelFile(model))
        log = write_slip_log(manifest, slip, folder / "derived.mcap", frame)
    except SlipError as error:
        require_one_line(error)
        counts[f"mcap: {error.code}"] += 1
    else:
        frames = set()
        with log.open("rb") as opened:
            reader = make_reader(opened, validate_crcs=True, decoder_factories=[DecoderFactory()])
            for _, channel, _, message in reader.iter_decoded_messages(topics=["/slip/pose"]):
                frames.add((channel.topic, message.header.frame_id))
        # A string of ROS ends at its first zero.
        if {one.split("\0")[0] for _, one in frames} != {frame.split("\0", maxsplit=1)[0]}:
            raise AssertionError(f"the frame {frame!r} came back as {frames}")
        counts["mcap"] += 1
    for path in write_tables(manifest, "csv", folder / "csv"):
        with path.open(encoding="utf-8", newline="") as opened:
            widths = {len(row) for row in csv.reader(opened)}
        if len(widths) != 1:
            raise AssertionError(f"{path.name} has rows of different lengths")
    counts["csv"] += 1


def run(seconds: float, seed: int, finds: Path | None, most: float = math.inf) -> Counter[str]:
    """Try cases for some time, at most so many; counts of what was written and of what was refused.

    Raises:
        BaseException: whatever a case raised, after keeping it.
    """
    rng = random.Random(seed)  # noqa: S311 - no secret
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        folder = Path(name)
        manifest = make_run(folder)
        warnings.simplefilter("error")
        end = time.monotonic() + seconds
        while time.monotonic() < end and counts["read"] + counts["refused"] < most:
            text = draw_model(rng)
            text = mutate([text], rng) if rng.random() < 0.3 else text
            own = {key: mutate([one], rng) for key, one in OWN_FILES.items()}
            frame = draw_name(rng)
            case = json.dumps({"model": text, "own": own, "frame": frame}).encode()
            with keep_failure(finds, f"export_{seed}_{counts.total()}.json", case, hang_s=HANG_S):
                file = open_case(text)
                counts["read" if file else "refused"] += 1
                if file is not None:
                    check_targets(file, own, folder, counts)
                    if counts["read"] % VIEWERS_EVERY == 1:
                        model = file.model if rng.random() < 0.5 else None
                        check_viewers(model, manifest, frame, folder, counts)
    return counts


def count_cases(seconds: float, seed: int, finds: Path) -> int:
    """Try cases, and print what was written and what was refused; the number of cases."""
    counts = run(seconds, seed, finds)
    for name, count in sorted(counts.items()):
        sys.stdout.write(f"{count:8d}  {name}\n")
    return counts["read"] + counts["refused"]


if __name__ == "__main__":
    raise SystemExit(run_script(__doc__, MEMORY, count_cases))
