"""Throws damaged model files, configurations and formulas at their readers and at the exports.

    python tests/fuzz/fuzz_texts.py --minutes 60 [--seed 1] [--finds folder]

Anything but a result or one clear error of a line is a find: another exception, a warning, a file that is not
read again as it was written, an export that is no Python or YAML. A case that takes longer than 10 s ends the
run with a traceback. A case that fails is kept in the folder of finds.
"""

import ast
import json
import random
import sys
import tempfile
import time
import warnings
from pathlib import Path
from xml.etree import ElementTree as ET

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT)]

import numpy as np  # noqa: E402 - the repository is put on the path first
import yaml  # noqa: E402
from fuzzing import keep_failure, run_script  # noqa: E402

from pipeline.core import SlipError  # noqa: E402
from pipeline.export import export_model, find_target, list_targets  # noqa: E402
from pipeline.models import format_model, list_effects  # noqa: E402
from pipeline.models.expression import parse_expression  # noqa: E402
from pipeline.models.formula import SIGNAL_UNITS  # noqa: E402
from pipeline.models.model_file import parse_model  # noqa: E402
from pipeline.models.parameter import parse_unit  # noqa: E402
from pipeline.sources import load_configuration, resolve_vehicle  # noqa: E402

HANG_S = 10
PARSERS = {
    "json": json.loads,
    "python": ast.parse,
    "gazebo": ET.fromstring,
    "latex": str,
    "px4": find_target("px4").read_current,
}
MEMORY = 3 << 30
LONGEST_ERROR = 4000
UNITS = {**{name: parse_unit(unit, "") for name, unit in SIGNAL_UNITS.items()}, "k": parse_unit("1", "")}
FORMULAS = (
    "k * v0",
    "k * sin(yaw) * v0",
    "-k * v0 * abs(v0) / max(abs(v0), hypot(v0, 2 * v0))",
    "k**2 * v0 - 3 * v0 / (2 - -k) * k^2",
    "min(v0, k * v0) * exp(-t / (t + t)) * sign(w0)",
    "sqrt(v0 * v0) * atan2(v0, v0) * tanh(k) * log(abs(k) + 1) * pi",
)
WORDS = (
    "inf",
    "-inf",
    "nan",
    "1e999",
    "9" * 350,
    "0x1",
    "1_0",
    "true",
    '"',
    '"""',
    "'",
    "\\",
    "\\u0000",
    "\n",
    "#",
    "[",
    "]",
    "[[",
    "{",
    "}",
    "=",
    ".",
    ",",
    "(",
    ")",
    "**",
    "^",
    "/",
    "-",
    "a.",
    "((((",
    "\u2028",
    "\x85",
    "\xb5",
    "\ud7ff",
    "2026-01-01",
    "{}",
    "id",
    "note",
    "where",
    "fixed",
    "effects",
    "value",
    "bounds",
    "neutral",
    "unit",
    "per_run",
    "sin",
    "log",
    "v_x",
    "v0",
    "9**9**9",
)
CONFIGURATION = """[vehicle]
preset = "husky_a200"
track_width_m = 0.555
[run]
dataset = "husky_tile"
terrain = "tile"
[command]
topic = "/wheel_commands"
left = ["front_left_wheel"]
unit = "rad/s"
sign = 1
hold_s = 0.5
[pose]
frames = ["map", "base_link"]
[velocity]
rate_hz = 20
window_s = 0.75
yaw = "pose"
[slip]
length_scale_m = 1.0
[[interval]]
topic = "/drive/calib_state"
equals = "calib"
[[interval]]
start_s = 1.5
end_s = 30
"""


def write_models() -> list[str]:
    """Valid model files of every kind."""
    texts = []
    for kind, preset in (("differential", "husky_a200"), ("ackermann", "ackermann_car")):
        effects = [
            f'[[effect]]\nid = "{effect.id}"\n'
            + "".join(
                f'{p.name} = {{ value = {p.typical!r}, unit = "{p.unit}", low = 0.0, high = inf }}\n'
                for p in effect.parameters
            )
            for effect in list_effects()
            if kind in effect.kinds
        ]
        texts += [f'format = 1\nnote = "n"\n[vehicle]\npreset = "{preset}"\n{effect}' for effect in effects]
        texts.append(f'[vehicle]\npreset = "{preset}"\n{"".join(effects)}')
    head = '[vehicle]\nname = "crab"\nkind = "differential"\nwheel_radius_m = 0.2\ntrack_width_m = 0.7\n'
    tail = 'k = { value = -0.5, unit = "1", bounds = [-1, 1], fixed = true, per_run = true }\n'
    texts += [f'{head}[[effect]]\nid = "wind"\nv_x = "{text}"\n{tail}' for text in FORMULAS]
    fit = (
        '[fit]\ninput = "command"\nblocks = 3\n[[fit.runs]]\nrun = "a/b"\nsha256 = "ab"\npose_delay_s = 0.1\n'
    )
    texts.append(f'{head}[[effect]]\nid = "tilt"\nk = 0.5\n{fit}')
    return texts


def mutate(texts: tuple[str, ...] | list[str], rng: random.Random) -> str:
    """One damaged text."""
    text = rng.choice(texts)
    for _ in range(rng.choice((0, 1, 1, 2, 3, 8))):
        place = rng.randrange(len(text) + 1)
        end = min(len(text), place + rng.randrange(1, 30))
        kind = rng.randrange(8)
        if kind <= 2:
            text = text[:place] + rng.choice(WORDS) + text[place:]
        elif kind == 3:
            text = text[:place] + rng.choice(WORDS) + text[end:]
        elif kind == 4:
            text = text[:place] + text[end:]
        elif kind == 5:
            text = text[:end] + text[place:end] * rng.choice((1, 2, 300)) + text[end:]
        elif kind == 6:
            other = rng.choice(texts)
            start = rng.randrange(len(other) + 1)
            text = text[:place] + other[start : start + rng.randrange(60)] + text[end:]
        else:
            text = (
                text[:place]
                + chr(rng.choice((0, 9, 10, 13, 27, 127, 0xA0, 0xE9, 0xFEFF, 0x1F600)))
                + text[place:]
            )
    return text


def require_one_line(error: SlipError) -> None:
    """Raise for an error that is no single readable line."""
    text = str(error)
    if "\n" in text or len(text) > LONGEST_ERROR:
        raise AssertionError(
            f"the error is no single line of readable length: {text[:LONGEST_ERROR]}"
        ) from error


def check_model(text: str) -> None:
    """Read a model file, write it, read it again, export it."""
    path = Path("m.toml")
    try:
        file = parse_model(text, path)
        written = format_model(file)
    except SlipError as error:
        require_one_line(error)
        return
    again = parse_model(written, path)
    if format_model(again) != written:
        raise AssertionError("written again, the model file is another one")
    for target in list_targets():
        try:
            exported = export_model(file, target.name)
        except SlipError as error:
            require_one_line(error)
        else:
            PARSERS.get(target.name, yaml.safe_load)(exported)


def check_configuration(text: str, folder: Path) -> None:
    """Read a configuration, and find its vehicle."""
    (folder / "run.toml").write_bytes(text.encode())
    try:
        found = load_configuration(folder / "log.mcap")
        resolve_vehicle(found.vehicle, recorded=None, where="log.mcap")
    except SlipError as error:
        require_one_line(error)


def check_formula(text: str, rng: random.Random) -> None:
    """Parse a formula and compute it."""
    values: dict[str, np.ndarray | float] = {
        name: np.array([rng.choice((0.0, 1.0, -1.0, 1e-9, 1e9, rng.gauss(0, 1))) for _ in range(4)])
        for name in SIGNAL_UNITS
    }
    values["k"] = rng.gauss(0, 1)
    try:
        result = parse_expression(text, UNITS, "m.toml:3").evaluate(values)
    except SlipError as error:
        require_one_line(error)
        return
    if not np.isfinite(result).all():
        raise AssertionError("what is not a finite number was not said")


def run(seconds: float, seed: int, finds: Path | None) -> int:
    """Try cases for some time; the count of them.

    Raises:
        BaseException: whatever a case raised, after keeping it.
    """
    rng = random.Random(seed)  # noqa: S311 - no secret
    models, cases = write_models(), 0
    end = time.monotonic() + seconds
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("error")
        while time.monotonic() < end:
            texts = [mutate(models, rng), mutate((CONFIGURATION,), rng), mutate(FORMULAS, rng)]
            case = json.dumps(texts).encode()
            with keep_failure(finds, f"find_{seed}_{cases}.json", case, hang_s=HANG_S):
                check_model(texts[0])
                check_configuration(texts[1], Path(name))
                check_formula(texts[2], rng)
            cases += 3
    return cases


if __name__ == "__main__":
    raise SystemExit(run_script(__doc__, MEMORY, run))
