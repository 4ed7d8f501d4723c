"""What nobody should give and somebody will: each verb answers with its exit code and one line that names it.

A row is an input, the verb that gets it, and a pattern of the line; with --json that line is one JSON object.
"""

import json
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from cyclopts import App
from verbs import run_verb

from pipeline.cli import build_app
from pipeline.logs.writer import LogWriter

START = 1_700_000_000_000_000_000
LONGEST_LINE, LONGEST_S = 1000, 5.0
NEVER_REFUSES = {"doctor"}

LOGS = {
    "missing.mcap": r"there is no such file\. Check the path",
    "field/wied.mcap": r"there is no such file.*Did you mean wide\.mcap",
    "empty.mcap": "is empty",
    "text.mcap": "MCAP",
    "no_pose.mcap": r"pose.*None of its topics holds poses: record.*/cmd_vel",
    "no_command.mcap": r"command.*\[command\] topic.*/odom",
    "no_vehicle.mcap": r"vehicle.*--vehicle.*husky_a200.*--wheel-radius",
    "only_images.mcap": r"no topic.*pose.*None of its topics holds poses: record.*/camera",
    "no_messages.mcap": "no message",
}
"""Logs in which no slip shows, for `slip analyze` and `slip inspect`."""

WORDS: list[tuple[str, str]] = [
    # Files of another kind, and names that nobody has
    ("analyze field/wide.mcap --config missing.toml", "missing.toml"),
    ("analyze field/wide.mcap --vehicle huskyA200", r"presets are husky_a200, "),
    (
        "analyze field/wide.mcap --wheel-radius 16 --track-width .5",
        r"it is in centimetres, write 0\.16; if it is in millimetres, write 0\.016\.",
    ),
    ("analyze field/wide.mcap --wheel-radius .1 --track-width 555", r"it is in centimetres, write 5\.55; if"),
    ("analyze field/wide.mcap --wheel-radius 330 --track-width .5", r"it is in millimetres, write 0\.33\."),
    ("analyze field/wide.mcap --drove 2", "2 is not a length with its unit"),
    ("analyze planned/dead.mcap", r"planned/dead\.mcap: it is a link to nothing\. Look where it leads"),
    ("analyze field/wide.mcap --memory much", r"'much' is not a size\. Write for example 500MB or 2GB\."),
    ("analyze field/wide.mcap --model missing.toml", "cannot be read"),
    ("analyze field/wide.mcap --model car.toml", "kind 'ackermann'"),
    ("inspect missing.mcap", r"missing\.mcap: there is no such file\. Check the path\."),
    ("inspect field/wide.mcap --max-inflated much", r"'much' is not a size"),
    ("diagnose missing.mcap", "there is no such file. Check the path."),
    ("diagnose no/such --results nowhere", "is neither a log nor a run"),
    ("diagnose field/wied", r"Did you mean field/wide\? There are: field/wide\."),
    ("diagnose field/wide --budget soon", "soon"),
    ("diagnose field/wide --model missing.toml", "missing.toml"),
    ("diagnose no/such --apply mine.toml", "there is no run 'no/such'. There are: field/wide."),
    ("diagnose field/wide --model jackal.toml", "--vehicle-of run"),
    ("watch missing.mcap", r"missing\.mcap: there is no such file\. Check the path\."),
    ("watch folder --for 1", "the folder holds no MCAP file"),
    ("export missing --to csv", "missing"),
    ("export text.mcap --to csv", r"text\.mcap: it has no results in results\. Analyze it first: slip"),
    ("results status text.mcap", r"slip analyze text\.mcap --results results\."),
    ("serve text.mcap", "text.mcap: it has no results in results"),
    ("serve missing.mcap --results nowhere", r"nowhere: 'missing\.mcap' is neither a log nor a run"),
    ("serve missing --memory much", "'much' is not a size"),
    ("effects nothing", "no effect is called 'nothing'"),
    # Files that are there already
    ("simulate", r"run\.mcap: the file already exists\. Give --force to replace it, or another name\."),
    ("simulate --file field/wide.mcap", "field/wide.mcap: the file already exists"),
    ("simulate husky_tile --file planned", "planned/husky_tile.mcap: the file already exists"),
    ("plan --vehicle husky_a200 --folder planned", "planned/plan.csv: the file already exists"),
    ("diagnose field/wide --apply husky.toml", "husky.toml: the file already exists"),
    ("export field/wide --to mcap --file field/wide.mcap", "field/wide.mcap: the file already exists"),
    ("export field/wide --to csv --file planned", "planned/slip.csv: the file already exists"),
    ("export field/wide --to foxglove-layout --file robot.json", "robot.json: the file already exists"),
    ("check husky.toml field/wide --to junit --file husky.toml", "husky.toml: the file already exists"),
    ("model export husky.toml --to json --file robot.json", "robot.json: the file already exists"),
    ("model new-effect dangling.py", r"dangling\.py: the file already exists"),
    # Models
    ("model show field/wide.mcap", "this is not a model file: it is not text"),
    ("model show folder", "folder: this is not a model file: it is a folder"),
    ("model show missing.toml", "missing.toml"),
    ("model new husky.toml --vehicle husky_a200", "husky.toml: the file already exists"),
    ("model new mine.toml --vehicle hunky", "hunky"),
    ("model new mine.toml --vehicle husky_a200 --from nobody", "nobody"),
    ("model new-effect wind.toml", r"side_wind\.py"),
    ("model new-effect drive_lag.py", "an effect is called so already"),
    ("model add missing.toml drive_lag --on field/wide", "missing.toml"),
    ("model add husky.toml mine --on field/wide --effects gone.py", "gone.py: cannot be read"),
    ("model show husky.toml --effects text.mcap", "text.mcap: the effects cannot be loaded"),
    ("model add husky.toml nothing --on field/wide", "no effect is called 'nothing'"),
    ("model add husky.toml effective_track --on text.mcap", "text.mcap"),
    ("model add husky.toml drive_lag --on", "--on names no run"),
    ("model add husky.toml drive_lag --on field/wide --input measured", "acts between command and wheels"),
    ("model add husky.toml slope_creep --on field/wide --quiet", "is not supported by the data"),
    ("model drop husky.toml drive_lag --on field/wide", "drive_lag"),
    ("model remove husky.toml drive_lag --on field/wide", "drive_lag"),
    ("model fit husky.toml --on text.mcap", "text.mcap"),
    ("model fit bad.toml --on field/wide", "bad.toml:1"),
    ("model fit jackal.toml --on field/wide", r"field/wide.*Husky.*Jackal.*wheel_radius_m.*--vehicle-of"),
    ("model fit husky.toml --on field/wide --first soon", "is not a duration"),
    ("model fit --on field/wide", "no model file was given"),
    ("model compare husky.toml missing.toml --on field/wide", "missing.toml"),
    ("model compare --on field/wide", "two model files are compared"),
    ("model literature nobody", "nobody"),
    ("model speed no.toml --on nowhere --within 10cm", "no.toml"),
    ("model export husky.toml --to ros_control", "Did you mean ros2_control"),
    ("model export husky.toml --to autoware", "husky_a200 is differential"),
    # Plans and simulations
    ("plan text.mcap", "text.mcap"),
    ("plan --vehicle nothing", "nothing"),
    ("plan --check husky.toml field/wide.mcap", "this is not a plan.toml"),
    ("plan --vehicle husky_a200 --time soon", "--time"),
    ("plan --vehicle husky_a200 --time 2h", "--time"),
    *((f"plan --vehicle husky_a200 --area {area}", "--area") for area in ("20", "0x5m", "ax3", "20x10km")),
    ("simulate husky_til --file x.mcap", "husky_tile"),
    ("simulate ideal_husky --effect effective_trak=1 --file x.mcap", "effective_track"),
    ("simulate ideal_husky --effect antigravity=1 --file x.mcap", "antigravity"),
    ("simulate ideal_husky --effect effective_track=kk:1.8 --file x.mcap", "kk"),
    ("simulate ideal_husky --effect effective_track=wide --file x.mcap", "wide"),
    ("simulate ideal_husky --effect lever_arm=.1 --file x.mcap", "l_x, l_y"),
    ("simulate ideal_husky --effect drive_lag=-.1 --file x.mcap", "at least 0"),
    ("simulate ideal_husky --effect lateral_skid=nan --file x.mcap", "finite"),
    ("simulate ideal_husky --effect understeer=.1 --file x.mcap", "ackermann"),
    ("simulate ideal_husky --effect drive_lag=tau:1,tau:2 --file x.mcap", "tau"),
    ("simulate ideal_husky --effect drive_lag=.3 --effect drive_lag=.5 --file x.mcap", "drive_lag"),
    ("simulate ideal_husky --duration .1 --file x.mcap", "duration_s"),
    # Several runs
    ("check field/wide field/wide", "a run is on both sides: field/wide. Give"),
    ("check husky.toml nowhere.mcap", "nowhere.mcap"),
    ("check husky.toml field/wide --limits nowhere.toml", "the limits cannot be read"),
    ("check field/wide husky.toml", "husky.toml: AFTER is a model file, and not what was driven"),
    ("check '' field/wide", "the check has no runs BEFORE"),
    ("check husky.toml ''", "the check has no runs AFTER"),
    ("check husky.toml field/wide --file check.md", "Add --to markdown, junit or html"),
    ("check folder folder", "there is no recording in it. Recordings are files that end in .mcap"),
    ("compare text.mcap", "this is not a results folder. Give the folder"),
    ("compare folder", "this is not a results folder. Give the folder"),
    ("compare --vehicle warthogg", "no run is of warthogg"),
    ("compare nobody husky_a200_lab_floor", "no dataset is called nobody"),
    ("compare husky_a200_lab_floor husky_a200_lab_floor", "is one dataset"),
    *(
        (f"{verb} --results nowhere", "nowhere: there are no results: there is no such folder. Give")
        for verb in (
            "compare", "compare --causes", "fleet fit", "fleet show", "fleet trend", "fleet map",
            "results status", "results verify", "results query 'SELECT 1'", "batch --prune",
        )
    ),
    # Batches and results
    ("batch", "no log is given"),
    ("batch nowhere", "no such file or folder"),
    ("batch folder", "there is no recording in it. Recordings are files that end in .mcap"),
    ("batch *.bag", r"\*\.bag: there is no recording in it"),
    ("batch field --quota 1GB", "--quota does nothing by itself"),
    ("batch field --shard 0/4", "is not a shard"),
    ("batch field --memory lots", "is not a size"),
    ("batch field --memory 1", "slip does not start within a memory limit of '1'"),
    (f"batch field --max-inflated {'9' * 400}", "is not a size"),
    ("batch field --prune --quota much", "is not a size"),
    ("results status nobody", "field/wide"),
    ("results stage extract text.mcap", "text.mcap"),
    ("results stage slip missing", "missing"),
    ("results verify --seed 3", "--seed does nothing by itself. Add --sample, as 5%."),
    *((f"results verify --sample {share}", "is not a share of the files") for share in ("0%", "101%")),
]  # fmt: skip
"""Words of a command, in the folder of the stored run, and what is said of them; each ends with 1."""

USAGE = (
    "fly", "analyze", "analyze log.mcap --wheel-radius -1", "analyze log.mcap --input guess",
    "results stage dream log.mcap", "effects --no-json", "model export robot.toml",
)  # fmt: skip
"""What is no command: it ends with 2."""

USAGE_WORDS = {
    "version": r"slip has no command version\. The version is shown by slip --version",
    "-v": r"shown by slip --version",
    "field/wide.mcap": r"no command field/wide\.mcap\. A log is analyzed by: slip analyze field/wide\.mcap",
    "analyze log.mcap --rate 3": r"slip analyze has no option --rate\. See slip analyze --help",
    "analyze log.mcap --vehicel x": r"no option --vehicel\. Did you mean --vehicle\? See",
}
"""What is said of some of these."""

HEAD = '[vehicle]\npreset = "husky_a200"\n'
TRACK = '[[effect]]\nid = "effective_track"\n'
FORMULA = '[[effect]]\nid = "w"\nv_y = "k * v0"\n'
MODELS = [
    (HEAD + TRACK + "k = 25.0\n", "5: .*outside of 0.1 to 20"),
    (HEAD + TRACK + "q = 2.0\n", "5: .*no parameter 'q'"),
    (HEAD + TRACK + 'k = "wide"\n', "5: .*is not a parameter"),
    (HEAD + TRACK + "k = { value = 1.7, low = 1.9, high = 1.6 }\n", "5: .*low = 1.9 .* is above its high"),
    (HEAD + TRACK + 'k = { value = 1.5, unit = "m" }\n', "5: .*is in 1, not in m"),
    (HEAD + TRACK + "k = inf\n", "5: .*not a finite number"),
    (HEAD + TRACK + "k = { value = -nan }\n", "5: .*not a finite number"),
    (HEAD + TRACK, r"4: .*effective_track has no number.*Write k, as k = 1\.\d"),
    (HEAD + 2 * (TRACK + "k = 1.5\n"), "7: .*twice"),
    (HEAD + '[[effect]]\nid = "effective_truck"\n', "4: .*no effect is called"),
    (HEAD + '[[effect]]\nid = "understeer"\n', "4: .*ackermann vehicles only"),
    (HEAD + '[[effect]]\nid = "two\\nlines"\n', "4: .*id of an effect"),
    (HEAD + f'[[effect]]\nid = "{"a" * 100}"\n', "4: .*id of an effect"),
    (HEAD + "[[effect]]\nk = 1.0\n", "3: .*needs an id"),
    (HEAD + FORMULA.replace("v0", "sin(yawn)") + 'k = { unit = "m/s" }\n', "5: .*'yawn'"),
    (HEAD + FORMULA + 'k = { unit = "m" }\n', "5: .*not in m/s"),
    (HEAD + FORMULA + 'k = { unit = "furlong" }\n', "not a unit"),
    (HEAD + FORMULA + f'k = {{ unit = "{"m*" * 1000}m" }}\n', "not a unit"),
    (HEAD + FORMULA + 'k = { unit = "1", bounds = [2, 1] }\n', "6: .*bounds"),
    (HEAD + FORMULA + "k = { value = 3, bounds = [-1, 1] }\n", "6: .*outside"),
    (HEAD + FORMULA + "k = { neutral = nan }\n", "6: .*neutral"),
    (HEAD + FORMULA + f"k = 1{'0' * 350}\n", "64 bits"),
    (HEAD + FORMULA.replace("k *", "self *") + "self = 0.5\n", "5: "),
    (HEAD + '[[effect]]\nid = "drive_lag"\nv_x = "k * v0"\nk = 0.1\n', "4: .*of the catalogue is called"),
    (HEAD + "wheel_radius_m = inf\n", "3: .*wheel_radius_m"),
    (HEAD + "colour = 1\n", r"3: .*unknown key 'colour' in \[vehicle\]"),
    (HEAD + "[effect]\n", r"3: .*\[\[effect\]\]"),
    (HEAD + "[[effect]\n", "3: .*not a valid TOML"),
    ('format = 7\n[vehicle]\npreset = "husky_a200"\n', "1: .*format 7"),
    ("colour = 1\n" + HEAD, "1: .*unknown key"),
    ('[vehicle]\npreset = "nope"\n', "2: .*no vehicle preset is called 'nope'. The nearest of "),
    ("[vehicle]\nwheel_radius_m = -1\n", "2: .*not valid"),
    ("format = 1\n", "1: .*no vehicle"),
    ('effects = ["mine.py"]\n' + HEAD, "1: .*unknown key 'effects'"),
    (HEAD + '[[effect]]\nid = "mine"\n', "4: no effect is called 'mine'.*--effects FILE.py"),
    ("note = " + "[" * 100_000, "deep"),
    ("a." * 200_000 + "b = 1\n", "parts"),
    *(
        (HEAD + FORMULA.replace('"k * v0"', json.dumps(text)) + "k = 0.5\n", r"odd\.toml(:[56])?: ")
        for text in (
            "v0 * 1" + "0" * 350, "v0 * 9**9**9", "(" * 240 + "v0" + ")" * 240,
            "v0 # a comment", "v0 ; v0", "'''v0'''", "v0 * 0x10", "v0 := 1", "v0\x00", "v\u043e0", "a.real",
            "__import__('os')", "[v0 for v0 in (1,)]", "v0 if k else v0", "v0 @ v0", "v0 +", "",
        )
    ),
]  # fmt: skip
"""Model files for `slip model show`, and what is said behind the file's name."""

CONFIGURATIONS = [
    ("[velocity]\nrate = 20\n", r"line 2: .*unknown key `rate` in `velocity`"),
    ("[vehicel]\n", r"line 1: .*unknown key `vehicel`"),
    ("[velocity]\nrate_hz = -1\n", r"velocity\.rate_hz"),
    ('[velocity]\nrate_hz = "fast"\n', r"velocity\.rate_hz"),
    (
        '[velocity]\nrate_hz = "20"\n',
        "line 2: .*a number belongs there, not a text, in `velocity.rate_hz`.*quotes",
    ),
    ('vehicle = "husky"\n', r"line 1: .*a section belongs there, not a text, in `vehicle`.*\[vehicle\]"),
    ("[velocity]\nrate_hz = inf\n", r"line 2: .*velocity\.rate_hz = inf is not a finite number"),
    ('[command]\nunit = "mph"\n', r"line 2: .*'mph' in `command\.unit`"),
    ('[pose]\nframes = ["map"]\n', r"pose\.frames"),
    ('[vehicle]\npreset = "huskie"', r"line 2: .*'huskie'.*nearest of [0-9]+ presets are husky_a200, "),
    ('\n[velocity]\nyaw = "gyro"', r"line 3: .*'gyro' in `velocity\.yaw`.*Write one of: imu, pose\."),
    ('[[interval]]\nstart_s = 1\n[[interval]]\nend_s = "late"', r"line 4: .*interval\[1\]\.end_s"),
    ("[[interval]]\nstart_s = 500\nend_s = 600\n", r"\[\[interval\]\]"),
    ("[run\n", "line 1"),
    ("[slip]\nlength_scale_m = 0xzz\n", "line 2: .*not a valid TOML"),
    (f"[slip]\nlength_scale_m = 1{'0' * 400}\n", "more than 64 bits"),
    (f"[slip]\nlength_scale_m = 1{'0' * 5000}\n", "thousands of digits"),
    ("a = " + "[" * 100_000, "deep"),
    ("[slip]\n" + "a." * 100_000 + "b = 1\n", "parts"),
    ("a = 1\n" * 500_000, "longer than"),
]
"""Files for `slip analyze --config`."""

FLEETS = [
    ('[[match]]\n[match.run]\nterrain = "x"\n', "glob"),
    ("match = 3\n", "match"),
    ('[[match]]\nglob = "other"\n[match.runs]\n', "runs"),
    ('[[match]]\nglob = "*"\n[match.command]\nunit = "mph"', r"line 4: .*'mph'.*km/h, m/s, mm/s, .*rad"),
]
"""Files named fleet.toml above a log."""

LIMITS = [
    ("[parameters]\n", r"unknown key `parameters`\. The keys there are: error, parameter, slip\."),
    (
        '[parameter]\n"drive_lag.tau" = {maximum = 1}',
        r"unknown key `maximum`.*The keys there are: change, max, min\.",
    ),
    ('[parameter]\n"drive_lag.tau" = {}', "no min, max or change"),
    ('[parameter]\n"drive_lag.tau" = {min = 2, max = 1}', "above its max"),
    ('[parameter]\n"drive_lag.tau" = {change = -0.1}', "not positive"),
    ("[error]\nposition = {max = nan}", "nan"),
    ("", "sets no limit"),
    ("[error\n", "line 1"),
]
"""Files for `slip check --limits`."""

GAINS = [
    ("vesc", "a: [", "is not YAML"),
    ("vesc", "a: &a {b: *a, c: [*a]}", "vesc.yaml"),
    ("vesc", "{a: " * 3000, "params"),
    ("vesc", "\x00", "params"),
    ("px4", "1 1 NAME\n", "vehicle, component, name"),
    ("nav2", "", "written without"),
]
"""Files of a robot for `slip model export --current`."""


@pytest.fixture(scope="module")
def folder(stored_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The stored run, beside files of every other kind."""
    folder = Path(shutil.copytree(stored_run, tmp_path_factory.mktemp("hostile") / "place", symlinks=True))
    (folder / "empty.mcap").touch()
    (folder / "text.mcap").write_text("this is no recording\n" * 100)
    (folder / "bad.toml").write_text("[model\n")
    (folder / "folder").mkdir()
    (folder / "folder" / "husky.txt").touch()
    (folder / "planned").mkdir()
    for name in ("run.mcap", "planned/husky_tile.mcap", "planned/plan.csv", "planned/slip.csv"):
        (folder / name).touch()
    (folder / "dangling.py").symlink_to("nowhere")
    (folder / "planned" / "dead.mcap").symlink_to("nowhere")
    (folder / "robot.json").write_text('{"format": 1}')
    for name, vehicle in (("jackal", "jackal"), ("car", "ackermann_car")):
        assert run_verb("model", "new", folder / f"{name}.toml", "--vehicle", vehicle).returncode == 0
    stamps = START + np.arange(200, dtype=np.int64) * 50_000_000
    pose = {"pose.pose.position.x": np.arange(200) * 0.02, "pose.pose.orientation.w": np.ones(200)}
    husky = {"vehicle": "husky_a200", "terrain": "tile", "note": "one:\n  - two"}
    with LogWriter(folder / "no_pose.mcap") as log:
        log.metadata("deployment", husky)
        log.write_columns("/cmd_vel", "geometry_msgs/msg/Twist", stamps, {"linear.x": np.ones(200)})
    with LogWriter(folder / "no_command.mcap") as log:
        log.metadata("deployment", husky)
        log.write_columns("/odom", "nav_msgs/msg/Odometry", stamps, pose, header_time=stamps)
    with LogWriter(folder / "only_images.mcap") as log:
        log.write_columns("/camera", "std_msgs/msg/String", stamps, {"data": "an image"})
    with LogWriter(folder / "no_vehicle.mcap") as log:
        for side in ("left", "right"):
            log.write_columns(f"/{side}_drive/velocity", "std_msgs/msg/Float64", stamps, {"data": 0.0})
        log.write_columns("/odom", "nav_msgs/msg/Odometry", stamps, pose, header_time=stamps)
    with LogWriter(folder / "no_messages.mcap") as log:
        log.metadata("deployment", husky)
    return folder


def list_files(folder: Path) -> set[Path]:
    """Files, but for locks and remembered hashes."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
    return {path for path in files if "identities" not in path.parts}


def refuse(folder: Path, words: list[str], pattern: str) -> str:
    """The one line with which a command is refused; nothing is printed, and no file is added."""
    before, begin = list_files(folder), time.monotonic()
    done = run_verb(*words, cwd=folder)
    assert time.monotonic() - begin < LONGEST_S
    assert (done.returncode, done.stdout) == (1, ""), done.stderr
    lines = done.stderr.splitlines()
    (line,) = [line for line in lines if line.startswith("slip: ")]
    assert line == lines[-1]
    assert len(line) < LONGEST_LINE
    assert re.search(pattern, line), line
    assert list_files(folder) == before
    return line


def split(command: str) -> list[str]:
    return [word.strip("'") for word in re.findall(r"'[^']*'|\S+", command)]


def list_verbs(app: App, chain: tuple[str, ...] = ()) -> Iterator[str]:
    """Verbs that take --json."""
    for name in app:
        if not name.startswith("-"):
            verb = app[name]
            yield from list_verbs(verb, (*chain, name))
            arguments = verb.assemble_argument_collection() if verb.default_command else ()
            if any("--json" in argument.names for argument in arguments):
                yield " ".join((*chain, name))


VERBS = sorted(list_verbs(build_app()), key=len, reverse=True)


def find_verb(command: str) -> str:
    """The verb of a command that takes --json; empty without one."""
    return next((verb for verb in VERBS if f"{command} ".startswith(f"{verb} ")), "")


def group_words() -> dict[str, list[tuple[str, str]]]:
    """Rows by their verb."""
    groups: dict[str, list[tuple[str, str]]] = {}
    for command, pattern in WORDS:
        groups.setdefault(find_verb(command) or command.split()[0], []).append((command, pattern))
    return groups


GROUPS = group_words()


def test_every_verb_has_a_row() -> None:
    assert set(VERBS) - NEVER_REFUSES <= GROUPS.keys()


@pytest.mark.parametrize("verb", GROUPS)
def test_words(folder: Path, verb: str) -> None:
    for command, pattern in GROUPS[verb]:
        line = refuse(folder, split(command), pattern)
    if verb not in VERBS:
        return
    done = run_verb(*split(command), "--json", cwd=folder)
    assert done.returncode == 1
    (error,) = json.loads(done.stdout)["errors"]
    assert error.keys() == {"path", "code", "message", "hint"}
    assert error["message"].removesuffix(f" ({error['path']})").partition(" (")[0] in line


def test_logs(folder: Path) -> None:
    for name, pattern in LOGS.items():
        line = refuse(folder, ["analyze", name, "--results", "elsewhere", "--quiet"], pattern)
        assert line.startswith(f"slip: {name}: ")
        seen = run_verb("inspect", name, cwd=folder)
        if seen.returncode == 1:
            assert seen.stderr.splitlines() == [line]
        else:
            why = line.removeprefix(f"slip: {name}: ")
            assert seen.returncode == 3
            assert seen.stdout.endswith(f"\nproblem   the log cannot be analyzed: {why}\n")


def test_usage(folder: Path) -> None:
    for command in USAGE:
        done = run_verb(*split(command), cwd=folder)
        assert (done.returncode, done.stdout) == (2, ""), command
        done = run_verb(*split(command), "--json", cwd=folder)
        (error,) = json.loads(done.stdout)["errors"]
        assert (done.returncode, error["code"]) == (2, "usage"), command


def test_usage_words(folder: Path) -> None:
    for command, pattern in USAGE_WORDS.items():
        (error,) = json.loads(run_verb(*split(command), "--json", cwd=folder).stdout)["errors"]
        assert re.search(pattern, error["message"]), error
    assert run_verb("analyze", "help", cwd=folder).stdout == run_verb("analyze", "--help", cwd=folder).stdout


def test_an_option_that_there_is_not(folder: Path) -> None:
    for verb in VERBS:
        done = run_verb(*verb.split(), "--no-such-option", "--json", cwd=folder)
        (error,) = json.loads(done.stdout)["errors"]
        assert (done.returncode, error["code"]) == (2, "usage"), verb


def test_model_files(folder: Path) -> None:
    for text, pattern in MODELS:
        (folder / "odd.toml").write_text(text, encoding="utf-8")
        refuse(
            folder,
            ["model", "show", "odd.toml"],
            rf"^slip: odd\.toml:?{pattern}" if pattern[1] == ":" else pattern,
        )


def test_configurations(folder: Path) -> None:
    words = ["analyze", "field/wide.mcap", "--config", "odd.toml", "--results", "elsewhere", "--quiet"]
    for text, pattern in CONFIGURATIONS:
        (folder / "odd.toml").write_text(text, encoding="utf-8")
        refuse(folder, words, rf"odd\.toml.*{pattern}" if "interval\\]\\]" not in pattern else pattern)


def test_fleet_files(folder: Path) -> None:
    fleet = folder / "field" / "fleet.toml"
    try:
        for text, pattern in FLEETS:
            fleet.write_text(text, encoding="utf-8")
            refuse(
                folder, ["analyze", "field/wide.mcap", "--results", "elsewhere"], rf"fleet\.toml.*{pattern}"
            )
    finally:
        fleet.unlink()


def test_limits(folder: Path) -> None:
    for text, pattern in LIMITS:
        (folder / "odd.toml").write_text(text, encoding="utf-8")
        refuse(
            folder, ["check", "husky.toml", "field/wide", "--limits", "odd.toml"], rf"odd\.toml.*{pattern}"
        )


def test_files_of_a_robot(folder: Path) -> None:
    for target, text, pattern in GAINS:
        model = "car.toml" if target == "vesc" else "husky.toml"
        (folder / "params").write_text(text, encoding="utf-8")
        refuse(folder, ["model", "export", model, "--to", target, "--current", "params"], pattern)
