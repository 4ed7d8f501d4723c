"""Throws damaged files at the command line; a traceback, a hang, a warning or a stray file is a find.

    python tests/fuzz/fuzz_cli.py --minutes 60 [--seed 1] [--finds folder]

Each case is a folder of small valid files (a log, a split recording with its metadata.yaml, run.toml,
fleet.toml, a model file, a results folder) of which one is damaged, and a verb that is given them. The verb
runs in a worker process with a limit of memory; a case that takes longer than 60 s is a find, too. Finds are
kept, and the run goes on: it ends with a table of verbs and exit codes, and with the finds by their place.
"""

import argparse
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

from cli_worker import Answer, Worker  # noqa: E402 - the repository is put on the path first
from fuzz_logs import mutate  # noqa: E402 - the repository is put on the path first

EXIT_CODES = {0, 1, 2, 3, 4}
TARGETS = (
    "ros2_control",
    "nav2",
    "autoware",
    "vesc",
    "px4",
    "robot_localization",
    "gazebo",
    "json",
    "python",
)
ODD_TEXTS = (
    *(
        "nan",
        "inf",
        "-inf",
        "-1",
        "0",
        "1e400",
        "1e-400",
        "9" * 400,
        str(2**63),
        str(2**64),
        "0x10",
        "true",
        '""',
    ),
    *(
        "'''",
        '"""',
        "[[",
        "]]",
        "{",
        "}",
        "[",
        "]",
        "=",
        ".",
        ",",
        "\n",
        "\r",
        "\x00",
        "\ufeff",
        "\u202e",
        "é",
        "#",
    ),
    *(
        "null",
        "../../../x",
        "/etc/passwd",
        "s3://x/y",
        "~",
        "%s",
        "{0}",
        "$HOME",
        '"\\ud800"',
        "id",
        "glob",
        "match",
    ),
    *("[" * 3000, "a." * 3000, "(" * 2000, "x" * 100_000),
)
RUN_TOML = """\
[vehicle]
preset = "husky_a200"
track_width_m = 0.555
[run]
dataset = "d"
terrain = "tile"
[command]
topic = "/controller/cmd_vel"
hold_s = 0.5
[pose]
topic = "/mapping/icp_odom"
[velocity]
rate_hz = 20
window_s = 0.75
[slip]
length_scale_m = 1.0
[[interval]]
start_s = 0.5
end_s = 5.0
"""
FLEET_TOML = '[run]\nterrain = "field"\n[[match]]\nglob = "*log*"\n[match.slip]\nlength_scale_m = 2.0\n'
_SHOWN = 300

FORMULA = """
[[effect]]
id = "crosswind"
v_y = "k * sin(yaw)"
k = { unit = "m/s", bounds = [-1, 1], value = 0.1 }
"""
METADATA = """\
rosbag2_bagfile_information:
  version: 5
  storage_identifier: mcap
  duration:
    nanoseconds: 6000000000
  relative_file_paths:
    - bag_0.mcap
    - bag_1.mcap
  message_count: 100
"""
QUERIES = (
    "SELECT * FROM runs",
    "SELECT run, count(*) AS n FROM slip GROUP BY run",
    "SELECT * FROM aggregates",
    "SELECT * FROM findings LIMIT 3",
    "SELECT v_x, v_y FROM velocities LIMIT 5",
)
"""Damaged like any other text."""


@dataclass
class Case:
    """A folder of files and what is asked of them.

    Attributes:
        folder: where the files are; the verb runs in it.
        arguments: of `slip`.
        damaged: what was damaged.
    """

    folder: Path
    arguments: list[str]
    damaged: str


@dataclass
class Tally:
    """What came of all cases."""

    codes: dict[str, Counter[object]] = field(default_factory=dict)
    finds: dict[str, list[str]] = field(default_factory=dict)


def make_seeds(folder: Path) -> None:
    """Valid files of every kind that a case is made of."""
    slip = [sys.executable, "-m", "pipeline"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}

    def run(*arguments: object) -> None:
        subprocess.run(
            [*slip, *map(str, arguments)], cwd=folder, check=True, env=environment, capture_output=True
        )

    folder.mkdir(parents=True, exist_ok=True)
    run("simulate", "husky_tile", "--file", "log.mcap", "--duration", "12", "--seed", "1")
    run("analyze", "log.mcap", "--no-diagnosis", "--results", "results")
    run("batch", "log.mcap", "--results", "results", "--executor", "inline")
    run("model", "new", "model.toml", "--vehicle", "husky_a200")
    run(
        "model",
        "add",
        "model.toml",
        "drive_lag",
        "lateral_skid",
        "--on",
        "log.mcap",
        "--anyway",
        "--quiet",
        "--results",
        "results",
    )
    with (folder / "model.toml").open("a") as model:
        model.write(FORMULA)
    (folder / "run.toml").write_text(RUN_TOML)
    (folder / "fleet.toml").write_text(FLEET_TOML)
    bag = folder / "bag"
    bag.mkdir()
    for number in (0, 1):
        shutil.copy(folder / "log.mcap", bag / f"bag_{number}.mcap")
    (bag / "metadata.yaml").write_text(METADATA)


def damage_text(text: str, rng: random.Random) -> str:
    """A text with a few words, lines or characters changed."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        kind = rng.randrange(6)
        place = rng.randrange(len(text) + 1)
        if kind == 0:
            text = text[:place] + rng.choice(ODD_TEXTS) + text[place + rng.randrange(3) :]
        elif kind == 1:
            words = list(re.finditer(r"[\w.\-/]+", text))
            if words:
                word = rng.choice(words)
                text = text[: word.start()] + rng.choice(ODD_TEXTS) + text[word.end() :]
        elif kind == 2:
            lines = text.split("\n")
            lines.insert(rng.randrange(len(lines) + 1), lines[rng.randrange(len(lines))])
            text = "\n".join(lines)
        elif kind == 3:
            lines = text.split("\n")
            del lines[rng.randrange(len(lines))]
            text = "\n".join(lines)
        elif kind == 4:
            text = text[:place]
        else:
            text = text[:place] + chr(rng.choice((0, 9, 34, 39, 91, 93, 0x7F, 0xE9, 0x2028))) + text[place:]
    return text


def damage_file(path: Path, rng: random.Random) -> None:
    """Damage a file as a text where it is one, else byte by byte."""
    content = path.read_bytes()
    if path.suffix in {".toml", ".json", ".yaml"} and rng.random() < 0.8:
        path.write_bytes(damage_text(content.decode(), rng).encode("utf-8", "surrogatepass"))
    else:
        path.write_bytes(mutate([content, content[::-1]], rng))


def make_case(seeds: Path, folder: Path, rng: random.Random) -> Case:
    """Copy what the case needs, damage one thing, choose a verb."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    kind = rng.choices(("log", "run", "fleet", "model", "results", "bag", "sql"), (6, 3, 2, 3, 6, 2, 1))[0]
    json_too = ["--json"] if rng.random() < 0.7 else []
    names = {"run": ["log.mcap", "run.toml"], "fleet": ["log.mcap", "fleet.toml"], "bag": ["bag"]}
    for name in names.get(kind, ["log.mcap", "model.toml", "results"]):
        source = seeds / name
        shutil.copytree(source, folder / name, symlinks=True) if source.is_dir() else shutil.copy(
            source, folder
        )
    analyze = ["--no-report", *(["--no-diagnosis"] if rng.random() < 0.9 else [])]
    on_log = [
        ["inspect", "log.mcap"],
        ["analyze", "log.mcap", *analyze, "--results", "out"],
        ["batch", "log.mcap", "--executor", "inline", "--settle", "0", "--results", "out"],
        ["results", "stage", "extract", "log.mcap", "--results", "out"],
    ]
    if kind == "model":
        target, verbs = (
            folder / "model.toml",
            [
                ["model", "show", "model.toml"],
                ["model", "export", "model.toml", "--to", rng.choice(TARGETS)],
                ["analyze", "log.mcap", *analyze, "--model", "model.toml", "--results", "out"],
            ],
        )
    elif kind == "results":
        files = [
            path for path in sorted((folder / "results").rglob("*")) if path.is_file() and path.stat().st_size
        ]
        notes = [path for path in files if path.suffix == ".json"]
        target = rng.choice(notes if rng.random() < 0.6 else files)
        run = next((folder / "results" / "runs").rglob("manifest.json")).parent.relative_to(
            folder / "results" / "runs"
        )
        verbs = [
            ["results", "status", "--results", "results"],
            ["results", "verify", "results"],
            ["results", "query", rng.choice(QUERIES), "--results", "results"],
            ["results", "status", str(run), "--results", "results"],
            [
                "export",
                str(run),
                "--to",
                rng.choice(("mcap", "csv")),
                "--results",
                "results",
                "--file",
                "out/x.mcap",
                "--force",
            ],
            ["batch", "log.mcap", "--executor", "inline", "--settle", "0", "--results", "results"],
            ["analyze", "log.mcap", *analyze, "--results", "results"],
            ["diagnose", str(run), "--results", "results"],
        ]
    elif kind == "bag":
        target, verbs = (
            folder / "bag" / "metadata.yaml",
            [
                ["inspect", "bag"],
                ["batch", "bag", "--executor", "inline", "--settle", "0", "--results", "out"],
            ],
        )
    elif kind == "sql":
        sql = damage_text(rng.choice(QUERIES), rng).replace("\x00", "")
        return Case(folder, ["results", "query", "--results", "results", *json_too, "--", sql], "sql")
    else:
        target, verbs = folder / {"log": "log.mcap", "run": "run.toml", "fleet": "fleet.toml"}[kind], on_log
    damage_file(target, rng)
    arguments = rng.choice(verbs)
    if arguments[0] == "export":
        json_too = []
    return Case(folder, [*arguments, *json_too], target.relative_to(folder).as_posix())


def list_files(folder: Path) -> dict[str, tuple[int, int]]:
    """Every file below a folder, with its size and time of change."""
    return {
        str(path.relative_to(folder)): (path.lstat().st_size, path.lstat().st_mtime_ns)
        for path in folder.rglob("*")
        if not path.is_dir()
    }


def judge(  # noqa: PLR0911 - one of many things may be wrong
    case: Case, answer: Answer, before: dict[str, tuple[int, int]], after: dict[str, tuple[int, int]]
) -> str:
    """What is wrong with an answer; empty when nothing is."""
    if answer.code is None:
        return answer.crash
    if answer.code not in EXIT_CODES:
        return f"exit code {answer.code}"
    if "Traceback (most recent call last)" in answer.err + answer.out:
        return answer.err
    if "Warning" in answer.err or "panicked" in answer.err:
        return f"a warning reached the user: {answer.err[-2000:]}"
    if answer.code == 1 and not (answer.err + answer.out).strip():
        return "it failed without a word"
    told = [line for line in answer.err.splitlines() if line.startswith("slip: ")]
    if answer.code == 1 and any(len(line) > 20_000 for line in told):
        return f"an error of {max(map(len, told))} characters"
    if "--json" in case.arguments and (answer.code in {0, 3, 4} or answer.out):
        try:
            json.loads(answer.out, parse_constant=lambda word: (_ for _ in ()).throw(ValueError(word)))
        except ValueError as error:
            return f"the JSON is none ({error}): {answer.out[:300]}"
    writable = ("out", "results")
    strange = sorted(
        name
        for name in before.keys() | after.keys()
        if before.get(name) != after.get(name) and name.partition(os.sep)[0] not in writable
    )
    return f"files outside the out folder: {strange}" if strange else ""


def name_find(wrong: str) -> str:
    """A find by its place in the program, so that one defect counts once."""
    places = re.findall(r'File ".*?/((?:pipeline|schemas)/[^"]+)", line \d+, in (\w+)', wrong)
    last = wrong.strip().splitlines()[-1][:160] if wrong.strip() else "?"
    return f"{places[-1][0]}:{places[-1][1]}: {last}" if places else wrong.strip()[:200]


def run(seconds: float, seed: int, finds: Path | None, *, most: int | None = None) -> Tally:
    """Try cases for some time, or so many."""
    rng = random.Random(seed)  # noqa: S311 - no secret
    tally = Tally()
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(temporary)
        make_seeds(place / "seeds")
        (place / "home").mkdir()
        worker = Worker(place / "home")
        end = time.monotonic() + seconds
        count = 0
        while time.monotonic() < end and (most is None or count < most):
            case = make_case(place / "seeds", place / "case", rng)
            kept = place / "kept"
            shutil.rmtree(kept, ignore_errors=True)
            shutil.copytree(case.folder, kept, symlinks=True)
            before = list_files(case.folder) | {
                f"home/{name}": said for name, said in list_files(place / "home").items()
            }
            answer = worker.run(case.folder, case.arguments)
            after = list_files(case.folder) | {
                f"home/{name}": said for name, said in list_files(place / "home").items()
            }
            wrong = judge(case, answer, before, after)
            verb = " ".join(
                case.arguments[: 2 if case.arguments[0] in {"model", "fleet", "results", "batch"} else 1]
            )
            tally.codes.setdefault(verb, Counter())[answer.code] += 1
            if wrong:
                note_find(tally, wrong, case, kept, finds / f"{seed}_{count}" if finds is not None else None)
            count += 1
        worker.end()
    return tally


def note_find(tally: Tally, wrong: str, case: Case, kept: Path, folder: Path | None) -> None:
    """Remember a find, and keep its files the first time."""
    name = name_find(wrong)
    known = tally.finds.setdefault(name, [])
    asked = " ".join(map(repr, case.arguments))
    known.append(f"slip {asked[:_SHOWN]}  (damaged: {case.damaged})")
    if folder is not None and len(known) == 1:
        shutil.copytree(kept, folder, symlinks=True, dirs_exist_ok=True)
        (folder / "FIND.txt").write_text(f"{known[0]}\n\n{wrong}\n", "utf-8", "replace")
        known[0] += f"  kept in {folder}"
        sys.stderr.write(f"find: {name}\n")


def describe(tally: Tally, minutes: float) -> str:
    """The closing table."""
    codes = [*sorted(EXIT_CODES), None]
    heads = "".join(f"{'crash' if code is None else code:>7}" for code in codes)
    lines = [f"{'verb':<18}{'cases':>7}{heads}   (by exit code)"]
    for verb, counts in sorted(tally.codes.items()):
        numbers = "".join(f"{counts[code]:>7}" for code in codes)
        lines.append(f"{verb:<18}{counts.total():>7}{numbers}")
    total = sum(counts.total() for counts in tally.codes.values())
    lines.append(f"{total} cases in {minutes:g} minutes, {len(tally.finds)} finds")
    for name, cases in tally.finds.items():
        lines += ["", f"{len(cases)} times: {name}", f"    {cases[0]}"]
    return "\n".join(lines) + "\n"


def main() -> int:
    """Run as a script."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--finds", type=Path, default=Path("fuzz_finds"))
    given = parser.parse_args()
    tally = run(given.minutes * 60.0, given.seed, given.finds.resolve())
    sys.stdout.write(describe(tally, given.minutes))
    return 1 if tally.finds else 0


if __name__ == "__main__":
    raise SystemExit(main())
