"""What a diagnosis says of real recordings: their known faults, plausible names, the same of one vehicle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.estimation import (
    EstimationData,
    Input,
    RunResiduals,
    diagnose_runs,
    fit_model,
    load_recording,
)
from pipeline.estimation.errors import measure_errors
from pipeline.estimation.plausibility import list_implausible
from pipeline.estimation.stored_diagnosis import read_recording
from pipeline.models import Model, Timing, find_effect
from pipeline.results import Errors, RunDiagnosis
from pipeline.results.reading import read_model
from pipeline.words import format_finding
from pipeline.words.verdict import format_verdict

if TYPE_CHECKING:
    from pipeline.run import MotionRun
    from pipeline.sources import Vehicle

_LOGS = Path(__file__).parents[2] / ".." / "shared" / "logs"

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not _LOGS.is_dir(), reason="the real recordings are not here"),
]

# What is known to be wrong with a recording.
_FAULTS: Mapping[str, set[str]] = {
    "husky_snow_boreal": {"command_scale", "bad_stretch", "held_poses", "pose_delay"},
    "husky_wheels-deflated_tile_2023_12_12_16h16": {"held_poses", "pose_delay"},
    "husky_wheels_avide2": {"not_moving"},
    "husky_wheels_plank_2024_10_24_11h24s5": {"wheels_dead", "not_moving"},
    "husky_wheels_wetgrass": set(),
    "warthog_gravel_1": {"bad_stretch", "held_poses", "pose_delay"},
    "warthog_wheels_asphalt": {"bad_stretch", "held_poses", "pose_delay"},
    "warthog_wheels_asphalt_2024_8_7_11h30s30": {"bad_stretch", "held_poses", "pose_delay"},
    "warthog_wheels_asphalt_2024_9_20_8h13s12": {"pose_delay"},
    "warthog_wheels_grass_2024_7_29_14h46s15": {"pose_delay"},
    "warthog_wheels_grass_2024_8_8_16h19s23": {"pose_delay"},
    "warthog_wheels_gravel_2024_8_6_11h37s32": {"imu_sign", "bad_stretch", "held_poses", "pose_delay"},
    "warthog_wheels_ice_2024_7_30_16h30s21": {"imu_sign", "bad_stretch", "held_poses", "pose_delay"},
    "warthog_wheels_sand_2024_9_25_14h32s32": {"held_poses", "pose_delay"},
}
_STANDING = {"husky_wheels_avide2", "husky_wheels_plank_2024_10_24_11h24s5"}
_DRIVEN = sorted(set(_FAULTS) - _STANDING)
# Share of the ideal model's error over 2 s, position and yaw, that is left on measured wheels.
_LEFT: Mapping[str, tuple[float, float]] = {
    "husky_snow_boreal": (0.43, 0.19),
    "husky_wheels-deflated_tile_2023_12_12_16h16": (0.23, 0.06),
    "husky_wheels_wetgrass": (0.81, 0.12),
    "warthog_gravel_1": (0.25, 0.14),
    "warthog_wheels_asphalt": (0.40, 0.14),
    "warthog_wheels_asphalt_2024_8_7_11h30s30": (0.40, 0.14),
    "warthog_wheels_asphalt_2024_9_20_8h13s12": (0.60, 0.07),
    "warthog_wheels_grass_2024_7_29_14h46s15": (0.56, 0.07),
    "warthog_wheels_grass_2024_8_8_16h19s23": (0.56, 0.07),
    "warthog_wheels_gravel_2024_8_6_11h37s32": (0.25, 0.14),
    "warthog_wheels_ice_2024_7_30_16h30s21": (0.48, 0.27),
    "warthog_wheels_sand_2024_9_25_14h32s32": (0.49, 0.22),
}
_ASPHALT = (
    "warthog_wheels_asphalt",
    "warthog_wheels_asphalt_2024_8_7_11h30s30",
    "warthog_wheels_asphalt_2024_9_20_8h13s12",
)
_GRASS = ("warthog_wheels_grass_2024_7_29_14h46s15", "warthog_wheels_grass_2024_8_8_16h19s23")
_GRAVEL = ("warthog_gravel_1", "warthog_wheels_gravel_2024_8_6_11h37s32")


@pytest.fixture(scope="module")
def known() -> dict[tuple[str, str], RunDiagnosis]:
    return {}


class Asked:
    """Diagnoses of the recordings, each made once."""

    def __init__(self, results: Path, known: dict[tuple[str, str], RunDiagnosis]) -> None:
        self.results, self.known = results, known

    def diagnose(self, name: str, source: str) -> RunDiagnosis:
        if (name, source) not in self.known:
            options = Options(out=self.results, report=False, diagnosis=False)
            vehicle, recording = read_recording(analyze_log(_LOGS / f"{name}.mcap", options).manifest)
            inputs = ("command", "measured") if source == "command" else ("measured",)
            (self.known[name, source],) = diagnose_runs([recording], vehicle, inputs=inputs).runs
        return self.known[name, source]

    def fit(self, name: str, source: str, ids: Sequence[str]) -> Model:
        vehicle, run = self._load(name)
        data = EstimationData([run], vehicle, Input(source))
        return fit_model(data, Model(vehicle, tuple(find_effect(each)() for each in ids)), exact=True).model

    def _load(self, name: str) -> tuple[Vehicle, MotionRun]:
        options = Options(out=self.results, report=False, diagnosis=False)
        vehicle, recording = read_recording(analyze_log(_LOGS / f"{name}.mcap", options).manifest)
        return vehicle, load_recording(recording, vehicle)

    def measure_as_recorded(self, name: str) -> Errors:
        """Errors of the ideal model on measured wheels, on the clocks as they were recorded."""
        vehicle, run = self._load(name)
        run_residuals = RunResiduals(run, vehicle, Input.MEASURED)
        timing, late = Timing(-run.alignment.wheel_delay_s), -run.alignment.heading_delay_s
        reached = run_residuals.find_horizon_errors((), timing, late)
        return measure_errors(run_residuals.find_residuals((), timing, late), reached.position, reached.yaw)


@pytest.fixture(scope="module")
def asked(recorded_results: Path, known: dict[tuple[str, str], RunDiagnosis]) -> Asked:
    return Asked(recorded_results, known)


def test_every_recording_is_looked_at() -> None:
    assert {path.stem for path in _LOGS.glob("*.mcap")} == set(_FAULTS)


@pytest.mark.parametrize("name", sorted(_FAULTS))
def test_known_faults_are_found_and_said(asked: Asked, name: str) -> None:
    found = {finding.id for finding in asked.diagnose(name, "measured").findings}
    assert _FAULTS[name] <= found


@pytest.mark.parametrize("name", sorted(_STANDING))
@pytest.mark.parametrize("source", ["command", "measured"])
def test_nothing_is_named_of_a_vehicle_that_stands(asked: Asked, name: str, source: str) -> None:
    run = asked.diagnose(name, source)
    assert run.effects == ()
    assert run.undecided == ()
    assert run.unexplained is None
    assert run.ladder == ()


def test_a_drivetrain_that_half_a_minute_shows_is_explained_from_commands(asked: Asked) -> None:
    rungs = asked.diagnose("warthog_wheels_asphalt_2024_9_20_8h13s12", "command").ladder
    assert rungs[-1].t_mrmse_m < 0.5 * rungs[0].t_mrmse_m


@pytest.mark.parametrize("name", _DRIVEN)
@pytest.mark.parametrize("source", ["command", "measured"])
def test_what_is_named_is_what_a_vehicle_can_do(asked: Asked, name: str, source: str) -> None:
    run = asked.diagnose(name, source)
    named = {effect.id: effect for effect in run.effects}
    for effect in run.effects:
        values = {key: value.value for key, value in effect.parameters.items()}
        assert not list_implausible(find_effect(effect.id)().change(**values))
    considered = {name for item in run.undecided for name in item.candidates}
    assert set(run.ladder[-1].effects) <= {*named, *considered}
    # Contact friction contains the track, and the model has either where the log does not decide.
    proposal = read_model(run)
    assert proposal is not None
    (has_track,) = (e for e in proposal.model.effects if e.id in {"contact_friction", "effective_track"})
    track = has_track.values["k"]
    assert 1.5 < track < (2.7 if name == "husky_snow_boreal" else 2.1)


@pytest.mark.parametrize("name", _DRIVEN)
def test_the_error_falls_as_far_as_it_can(asked: Asked, name: str) -> None:
    run = asked.diagnose(name, "measured")
    last, recorded = run.ladder[-1], asked.measure_as_recorded(name)
    position, yaw = _LEFT[name]
    assert last.t_mrmse_m < position * recorded.t_mrmse_m
    assert last.r_mrmse_rad < yaw * recorded.r_mrmse_rad
    assert run.noise_floor is not None
    assert run.noise_floor.t_mrmse_m < 1.2 * last.t_mrmse_m


@pytest.mark.parametrize("names", [_ASPHALT, _GRASS, _GRAVEL])
@pytest.mark.parametrize("source", ["command", "measured"])
def test_runs_of_one_vehicle_on_one_ground_agree(asked: Asked, names: tuple[str, ...], source: str) -> None:
    # A track beside one that depends on speed is another number: the same model is fitted to each run.
    common = set.intersection(*({e.id for e in asked.diagnose(name, source).effects} for name in names))
    # Where wheels slide little, contact friction is a track: one that is named on some runs is one on all.
    track = "contact_friction" if "contact_friction" in common else "effective_track"
    tracks = [asked.fit(name, source, sorted(common | {track})).effect(track).values["k"] for name in names]
    # Two drives on gravel, a day apart, differ by 3.3 %; all others by less.
    assert max(tracks) <= 1.04 * min(tracks)


@pytest.mark.parametrize("source", ["command", "measured"])
def test_on_ice_what_is_left_is_no_structure(asked: Asked, source: str) -> None:
    """It lasts for a second (correlation .25 to .33), and neither commands nor slopes predict it."""
    run = asked.diagnose("warthog_wheels_ice_2024_7_30_16h30s21", source)
    assert "at the noise floor" in format_verdict(run)
    assert run.unexplained is None or run.unexplained.kind == "lasting"


def test_a_part_of_a_named_effect_has_no_detection_limit(asked: Asked) -> None:
    """The wider track is part of contact friction: how large another one must be is no question."""
    run = asked.diagnose("warthog_wheels_ice_2024_7_30_16h30s21", "command")
    assert "contact_friction" in {effect.id for effect in run.effects}
    parts = {name for effect in run.effects for name in find_effect(effect.id).contains}
    assert "effective_track" in parts
    assert not parts & {one.id for one in run.detectable}


def test_the_servo_of_the_warthog_explains_its_turning(asked: Asked) -> None:
    run = asked.diagnose("warthog_wheels_asphalt_2024_8_7_11h30s30", "command")
    named = {effect.id: effect for effect in run.effects}
    # Half-second means of the raw encoders under commands beyond it are 13.0 to 13.5 rad/s.
    assert 12.5 < named["wheel_speed_limit"].parameters["limit"].value < 13.5
    assert run.ladder[-1].r_mrmse_rad < 0.12 * run.ladder[0].r_mrmse_rad


def test_the_left_motor_of_the_warthog_is_weaker(asked: Asked) -> None:
    """As the outer ones of a turn they reach 88 and 80 % of their command, the right ones 91 and 90 %."""
    run = asked.diagnose("warthog_wheels_asphalt", "command")
    named = {effect.id: effect for effect in run.effects}
    assert 0.07 < named["motor_imbalance"].parameters["e"].value < 0.2
    assert run.ladder[-1].r_mrmse_rad < 0.08  # .111 without it


@pytest.mark.parametrize("source", ["command", "measured"])
def test_an_inertia_that_halves_a_skid_is_named_or_told_with_it(asked: Asked, source: str) -> None:
    named = {effect.id: effect for effect in asked.diagnose("warthog_gravel_1", source).effects}
    skid = named["lateral_skid"]
    alone = asked.fit("warthog_gravel_1", source, ["effective_track", "lateral_skid"])
    # Contact friction contains the inertia.
    assert named.keys() & {"body_inertia", "contact_friction"}
    assert skid.parameters["c"].value < 0.6 * alone.effect("lateral_skid").values["c"]


def test_a_crab_angle_is_told_and_a_track_has_no_clock_for_a_rival(asked: Asked) -> None:
    """On tile the poses drift sideways by .025 of the way, forward and backward; a clock promises more."""
    run = asked.diagnose("husky_wheels-deflated_tile_2023_12_12_16h16", "measured")
    (told,) = (finding for finding in run.findings if finding.id == "pose_angle")
    assert "heading_deg = 1.6 under [pose]" in format_finding(told)
    assert not any("effective_track" in group.candidates for group in run.undecided)
