"""Structs of a diagnosis: ids, and numbers with units; one that is not known is NaN, and null in JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeVar, cast

import msgspec
from msgspec.structs import replace

from pipeline.core import NORMAL_95, round_numbers
from pipeline.models import Asked, Number, split_determined
from pipeline.recording import Finding
from pipeline.sources import Vehicle
from pipeline.store import convert_stored

Result = TypeVar("Result", bound=msgspec.Struct)
Json = None | bool | int | float | str | Sequence["Json"] | Mapping[str, "Json"]


class Moves(msgspec.Struct, frozen=True):
    """RMS change of predictions over 2 s by an effect.

    Attributes:
        position_m: distance [m].
        heading_rad: turn [rad].
        path_share: the distance as a share of the predicted distance.
    """

    position_m: float
    heading_rad: float
    path_share: float


class GrownEvidence(msgspec.Struct, frozen=True):
    """Evidence `t` for an effect [standard errors] by the seconds of driving."""

    seconds: tuple[float, ...] = ()
    t: tuple[float, ...] = ()


class Narrowing(msgspec.Struct, frozen=True):
    """Half-width of a 95 % interval [unit of the parameter] by the seconds of driving."""

    seconds: tuple[float, ...] = ()
    half_width: tuple[float, ...] = ()


class Growth(msgspec.Struct, frozen=True):
    """Evidence and intervals of an effect by driving time, at most sixty points each.

    Attributes:
        evidence: None where the effect was not searched for.
        parameters: by parameter.
    """

    evidence: GrownEvidence | None = None
    parameters: dict[str, Narrowing] = {}


class Named(msgspec.Struct, frozen=True, rename={"path": "found_on"}):
    """An effect that is missing from the model.

    Attributes:
        id: the simplest of its class.
        parameters: its values.
        gain: relative rise of the held-out loss when it alone is dropped.
        equivalent_to: ids of equivalent effects.
        confused_with: effects that look alike at first order.
        corrected: whether it is a clock corrected before any fit, which the written model does not contain.
        path: path on which it was identified: `command`, `measured` or `wheels`.
        selection_frequency: share of resampled recordings in which its gain reaches the threshold.
        moves: its change of predictions over 2 s; None where the model does not contain it.
        growth: its evidence and intervals by driving time; None where the model does not contain it.
        by_run: its values in each of the runs that were judged together, where runs or grounds have their
            own; those of this run are `parameters`.
    """

    id: str
    parameters: dict[str, Number] = {}
    gain: float = math.nan
    equivalent_to: tuple[str, ...] = ()
    confused_with: tuple[str, ...] = ()
    corrected: bool = False
    path: str = ""
    selection_frequency: float = math.nan
    moves: Moves | None = None
    growth: Growth | None = None
    by_run: tuple[dict[str, Number], ...] = ()

    @property
    def is_determined(self) -> bool:
        """Whether the runs determine one of its numbers; a corrected clock was measured beforehand."""
        known = any(split_determined(one)[0] for one in (self.parameters, *self.by_run))
        return self.corrected or not self.parameters or known

    @property
    def stands_out(self) -> bool:
        """Whether people act on it however little error it removes in this run.

        It is a clock that was corrected before the first fit, which no step of the ladder shows, or a number
        that the run knows is as large as is typical of the effect: commands that arrive late matter in
        another drive.
        """
        from pipeline.models import list_effects  # noqa: PLC0415 - heavy

        kind = next((kind for kind in list_effects() if kind.id == self.id), None)
        return self.corrected or any(
            parameter.is_large(value.value) and not value.is_open(parameter)
            for parameter in (() if kind is None else kind.parameters)
            if (value := self.shown.get(parameter.name)) is not None
        )

    @property
    def own(self) -> set[str]:
        """Names of its values that differ between runs."""
        return {
            name for name, value in self.parameters.items() if any(one[name] != value for one in self.by_run)
        }

    @property
    def shown(self) -> Mapping[str, Number]:
        """The values that the runs determine; all those of a corrected clock."""
        return self.parameters if self.corrected else split_determined(self.parameters)[0]


class EstimatedNumber(msgspec.Struct, frozen=True):
    """Estimate of a parameter in a run, whether or not the effect was identified: the data of fleet fits.

    Attributes:
        input: `command` or `measured`, from which the model predicts.
        effect, parameter, unit: which parameter.
        value: the estimate; for an effect that was not identified, that of one step of a joint fit.
        standard_error: half of its 95 % interval over 1.96.
        named: whether the diagnosis names the effect.
        at_bound: whether it is at a bound of the search.
        in_model: whether the written model contains the effect, including one of each undecided group.
    """

    input: str
    effect: str
    parameter: str
    unit: str
    value: float
    standard_error: float
    named: bool
    at_bound: bool
    in_model: bool


class Undecided(msgspec.Struct, frozen=True):
    """Effects of which one acts, but the log does not determine which.

    Attributes:
        candidates: ids, the chosen one first.
        parameters: values of each one in place of the others, in the first run, by id and parameter.
        in_model: the candidate that the model contains, whose error is that of any of them; None without.
    """

    candidates: tuple[str, ...]
    parameters: dict[str, dict[str, Number]] = {}
    in_model: str | None = None


class Unobservable(msgspec.Struct, frozen=True):
    """Why an effect is not observable: `no excitation`, or `collinear with what was named`."""

    reason: str


class Detectable(msgspec.Struct, frozen=True, rename={"id": "effect"}):
    """Detection threshold of an effect that was not named in this log.

    Attributes:
        id: id of the effect.
        parameter, unit: its parameter.
        size: threshold, as a distance from the neutral value of the parameter.
    """

    id: str
    parameter: str
    unit: str
    size: float


class Region(msgspec.Struct, frozen=True):
    """A region with its share of the error.

    Attributes:
        channel: x, y or w.
        kind: `command`, `phase`, `slope`, `time` or `place`.
        id: which one of that kind, a key of `pipeline.words.errors.REGIONS`.
        limits: between which numbers it lies, in the order of its words [m/s, rad/s, degrees, s, m].
        share: of the channel's squared error.
        time_share: of the windows.
        rms: error in the region [m/s or rad/s].
        expected: expected share of the squared error: the share of the windows, or for a time or a place the
            prediction from the same commands elsewhere.
    """

    channel: str = "x"
    kind: str = ""
    id: str = ""
    limits: tuple[float, ...] = ()
    share: float = math.nan
    time_share: float = math.nan
    rms: float = math.nan
    expected: float = math.nan


class Stretch(msgspec.Struct, frozen=True):
    """A stretch of time [s] with its share of a squared error."""

    t_start: float
    t_end: float
    share: float


class Moments(msgspec.Struct, frozen=True):
    """The times of a run in which half of the squared error of the 2 s predictions of a model arises.

    Attributes:
        quantity: `position` or `heading`.
        time_share: of the predictions.
        spans: the largest share first.
        run: number of the run.
    """

    quantity: str
    time_share: float
    spans: tuple[Stretch, ...]
    run: int = 0


class Errors(
    msgspec.Struct,
    frozen=True,
    rename={"t_mean_m": "published_t_mean_m", "r_mean_rad": "published_r_mean_rad"},
):
    """Errors of a model.

    Attributes:
        velocity_rms: rms of displacement over half a second, over half a second: x, y [m/s], w [rad/s].
        velocity_spread: 1.4826 times the median size of the same; far below the rms if few stretches
            contain most of the error.
        t_mrmse_m: root mean square position error over windows and steps of a 2 s horizon [m].
        r_mrmse_rad: the same of the wrapped yaw [rad].
        t_mean_m, r_mean_rad: the published variant: mean of the per-step error norms.
        t_median_m, r_median_rad: median of the same: the error of a typical prediction.
        windows: number of windows scored.
    """

    velocity_rms: tuple[float, ...] = ()
    velocity_spread: tuple[float, ...] = ()
    t_mrmse_m: float = math.nan
    r_mrmse_rad: float = math.nan
    t_mean_m: float = math.nan
    r_mean_rad: float = math.nan
    t_median_m: float = math.nan
    r_median_rad: float = math.nan
    windows: int = 0

    def ratios(self, other: Errors) -> tuple[float, float, float, float, float]:
        """Ratios of these errors to others: x, y, w, T, R."""
        mine = (*self.velocity_rms, self.t_mrmse_m, self.r_mrmse_rad)
        theirs = (*other.velocity_rms, other.t_mrmse_m, other.r_mrmse_rad)
        x, y, w, t, r = (a / b if b > 0.0 else math.nan for a, b in zip(mine, theirs, strict=True))
        return x, y, w, t, r


class Step(Errors, frozen=True):
    """A step of the ladder: the effects of a model and its held-out errors.

    Attributes:
        effects: their ids.
        explained_share: of the removable error; NaN where the ideal model is at the noise floor.
        rises: which errors over 2 s rise from the step before.
    """

    effects: tuple[str, ...] = ()
    explained_share: float = math.nan
    rises: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        errors: Errors,
        effects: tuple[str, ...],
        explained_share: float = math.nan,
        rises: tuple[str, ...] = (),
    ) -> Step:
        """The errors of a model as a step."""
        return cls(
            **msgspec.structs.asdict(errors), effects=effects, explained_share=explained_share, rises=rises
        )


class PathLadder(msgspec.Struct, frozen=True):
    """The ladder of one path: `measured` wheels to body, or command to `wheels`."""

    effects: tuple[str, ...] = ()
    ladder: tuple[Step, ...] = ()
    noise_floor: Errors | None = None


class Unexplained(msgspec.Struct, frozen=True, rename={"path": "found_on"}):
    """Structure of the residual that no catalogued effect explains.

    Attributes:
        kind: `formula`, `lasting` or `region`: what describes it.
        share: of the held-out loss of the model that a function of the recorded signals removes; or of the
            residual's variance that is correlated for longer than noise and random motion.
        channel: x, y or w.
        channels: every channel with structure.
        path: path of the search that identified it.
        sizes: RMS of lasting motion by channel [m/s, rad/s].
        region: with nearly all of the error.
        formula: a formula effect as text of a model file, a suggestion that no model holds.
        with_formula: held-out errors of the model with the formula.
    """

    kind: str = ""
    share: float = math.nan
    channel: str = "x"
    channels: tuple[str, ...] = ()
    path: str = ""
    sizes: dict[str, float] = {}
    region: Region | None = None
    formula: str | None = None
    with_formula: Errors | None = None


class Refused(msgspec.Struct, frozen=True, rename={"id": "effect"}):
    """An effect that would remove much of what a model leaves, and that lacks the evidence for a name.

    Attributes:
        id: of the effect.
        reason: against its name, as a clause.
        errors: held-out errors of the model with it.
    """

    id: str
    reason: str
    errors: Errors


class Delays(msgspec.Struct, frozen=True):
    """Delays of a run [s], and the source of its heading: `gyro` or `pose`."""

    heading: str = ""
    pose_delay_s: float | None = None
    yaw_delay_s: float | None = None
    wheel_delay_s: float | None = None


class Disturbance(msgspec.Struct, frozen=True):
    """The residual of x, y, w.

    Attributes:
        rms: of the residual [m/s, m/s, rad/s].
        lasting: the disturbance in it that is no noise of poses [m/s, m/s, rad/s].
        pose_noise: error of single poses [m, m, rad].
    """

    rms: tuple[float, ...] = ()
    lasting: tuple[float, ...] = ()
    pose_noise: tuple[float, ...] = ()


class Share(msgspec.Struct, frozen=True):
    """Share of one cause in a mean square.

    Attributes:
        effect: id of the effect.
        share: of the whole; below zero for an effect that increases the held-out error.
        low, high: 95 % interval over stretches of ten seconds, with the model's parameters held fixed; NaN
            with fewer than three.
        alone: share that the effect removes from the ideal model by itself; NaN where it is no effect.
        last: share that it removes after all others. Both equal the share of an effect independent of the
            others; their difference is shared with others.
    """

    effect: str = ""
    share: float = math.nan
    low: float = math.nan
    high: float = math.nan
    alone: float = math.nan
    last: float = math.nan


class SlipBudget(msgspec.Struct, frozen=True):
    """A mean square and its apportionment by cause.

    Attributes:
        input: `command` or `measured`, from which the model predicts.
        quantity: `slip`, `position` or `heading`.
        total: held-out mean square of the ideal model, in `unit`.
        unit: of the total.
        stretches: number of ten-second stretches used for the intervals.
        shares: of the effects, the largest first; with disturbance and localization noise they add up to one.
        disturbance, localization_noise: shares of the rest.
    """

    input: str
    quantity: str
    total: float
    unit: str = ""
    stretches: int = 0
    shares: tuple[Share, ...] = ()
    disturbance: Share | None = None
    localization_noise: Share | None = None

    @property
    def causes(self) -> list[tuple[str, Share]]:
        """Every cause with its kind: `effect`, `disturbance` or `localization_noise`."""
        remaining = {"disturbance": self.disturbance, "localization_noise": self.localization_noise}
        rest = [(kind, replace(one, effect=kind)) for kind, one in remaining.items() if one is not None]
        return [("effect", one) for one in self.shares] + rest


class CommandedTurn(msgspec.Struct, frozen=True):
    """Share of the commanded yaw rate that a robot reaches, with its 95 % interval.

    Attributes:
        share: measured over commanded yaw rate; after a lag and a dead time.
        low, high: its interval.
        controller_multiplier: yaw rate of the commanded wheels at the nominal track over that of the body
            command.
    """

    share: float
    low: float
    high: float
    controller_multiplier: float

    @property
    def deviation(self) -> float:
        """Standard deviation of the logarithm of the share."""
        return math.log(self.high / self.share) / NORMAL_95


class DataNeed(msgspec.Struct, frozen=True):
    """How well the driven time determines the parameters, and how much more is needed.

    Attributes:
        known: labels of the parameters that are known to a twentieth, and in no doubt.
        since_s, driven_s: after which time the last of them was, and the whole [s]; NaN where one of them has
            no interval by driving time.
        is_typical: whether the twentieth is of a typical value for one of them.
        vague: label of the least known one; empty without.
        half_width, unit: of its interval.
        others: how many more are not known to a twentieth.
        minutes: more minutes of such driving for it; 0 where driving does not narrow its interval.
        open: parameters that are not determined, or in doubt.
        idle_share: of the drive, at its end, that narrowed no interval by more than a tenth.
    """

    known: tuple[str, ...] = ()
    since_s: float = math.nan
    driven_s: float = 0.0
    is_typical: bool = False
    vague: str = ""
    half_width: float = math.nan
    unit: str = "1"
    others: int = 0
    minutes: int = 0
    open: int = 0
    idle_share: float = 0.0


class RunDiagnosis(msgspec.Struct, frozen=True, rename={"by_path": "by_way"}):
    """Effects missing from the model of one run, or of several runs of one vehicle together.

    Attributes:
        run: its name.
        input: `command` or `measured`, from which the model predicts; empty where the log has too little
            data for a diagnosis.
        input_reason: reason for this input; empty where nothing was fitted.
        joint: names of all runs that were judged together.
        vehicle: of the runs; None where nothing was fitted.
        effects: missing effects.
        undecided: alternatives that fit equally well.
        unobservable_why: effects not observable in this log.
        detectable: detection limits of the other effects that were not identified.
        refused: effects that would remove much of what a model leaves that is far above the noise floor, and
            that lack the evidence for a name; what leaves least first.
        unexplained: residual structure without a known cause; None without.
        findings: of the stages and of the diagnosis.
        ladder: steps with their held-out errors.
        noise_floor: repeatability of the motion under the same input, as errors.
        explained_share: of the removable error; NaN where the ideal model is at the noise floor.
        where: the few regions with most of the error of the ideal model.
        when: the times with half of the error that the model leaves.
        timing: delays, and the source of the heading.
        by_path: separate ladders of the drivetrain and of the ground, where there are encoders.
        disturbance: the residual.
        concentrated: the region with most of the error of the final model; None where it is spread evenly.
        model: model file with the identified effects, fitted, as text; None where no model could be judged.
        budget: causes of the slip and of the 2 s errors of the ideal model, for each input.
        need: whether the log is long enough; None where no effect has a number that was fitted.
        commanded_turn: share of the commanded yaw rate that the robot reaches; None without a body command.
        asked: the largest motion that the run asks for; None where nothing was fitted.
    """

    run: str = ""
    input: str = ""
    input_reason: str | None = None
    joint: tuple[str, ...] = ()
    vehicle: Vehicle | None = None
    effects: tuple[Named, ...] = ()
    undecided: tuple[Undecided, ...] = ()
    unobservable_why: dict[str, Unobservable] = {}
    detectable: tuple[Detectable, ...] = ()
    refused: tuple[Refused, ...] = ()
    unexplained: Unexplained | None = None
    findings: tuple[Finding, ...] = ()
    ladder: tuple[Step, ...] = ()
    noise_floor: Errors | None = None
    explained_share: float = math.nan
    where: tuple[Region, ...] = ()
    when: tuple[Moments, ...] = ()
    timing: Delays = Delays()
    by_path: dict[str, PathLadder] = {}
    disturbance: Disturbance | None = None
    concentrated: Region | None = None
    model: str | None = None
    budget: tuple[SlipBudget, ...] = ()
    need: DataNeed | None = None
    commanded_turn: CommandedTurn | None = None
    asked: Asked | None = None

    def list_own(self) -> dict[str, dict[str, Number]]:
        """Numbers that runs judged together have of their own: by label ``effect.name``, then by run."""
        return {
            f"{effect.id}.{name}": {
                run: numbers[name] for run, numbers in zip(self.joint, effect.by_run, strict=True)
            }
            for effect in self.effects
            for name in effect.parameters
            if name in effect.own
        }

    @property
    def has_suggestion(self) -> bool:
        """Whether a formula is suggested that would lower the error, and that no model holds yet."""
        return self.unexplained is not None and self.unexplained.with_formula is not None


_NUMBERS = frozenset(
    field.encode_name
    for kind in list(globals().values())
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct) and kind is not Vehicle
    for field in msgspec.structs.fields(kind)
    if field.type in (float, tuple[float, ...])
)
"""Keys of numbers that are NaN where JSON has null."""


def to_json(result: msgspec.Struct) -> dict[str, Json]:
    """A result as JSON: six digits, null for what is not known."""
    return cast("dict[str, Json]", round_numbers(msgspec.to_builtins(result)))


def read_result(content: Mapping[str, object], kind: type[Result], where: Path = Path()) -> Result:
    """A result from its JSON object.

    Args:
        content: the object.
        kind: class of the result.
        where: its file.

    Raises:
        StoreError: ``file_damaged``, a key has another type.
    """
    return convert_stored(_fill(content), kind, where, strict=False)


def _fill(value: object, key: str = "") -> object:
    if value is None:
        return math.nan if key in _NUMBERS else None
    if isinstance(value, Mapping):
        # By the names of errors, where it is no number.
        return {name: _fill(one, "" if key == "explained_share" else name) for name, one in value.items()}
    return [_fill(one, key) for one in value] if isinstance(value, list | tuple) else value
