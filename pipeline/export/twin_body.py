"""Physical body that moves like a fitted model: masses, wheels and their creep.

Creep: a force on a wheel moves it against the ground at a proportional speed, with separate coefficients
along its axle and across it. A body of mass M on such wheels obeys

    v_y = -T_aside v w,    k = (B / b) (1 + (L / B)^2 T_along / T_aside),    T = M / (sum of the coefficients)

so that lateral skid gives T_aside and the effective track gives T_along. Wheels that slide have a finite
friction coefficient; their body has the moment of inertia of the model, and their axles its distance. B and L
are the distances between the sides and between the axles. The delay T_along of the body is subtracted from
the delays of the servos.
Source: force-dependent slip of Open Dynamics Engine; Wong, Theory of Ground Vehicles, chapter 1.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

from pipeline.core.rigid import GRAVITY_MPS2
from pipeline.export import require_factors
from pipeline.models.effect import Effect, Place
from pipeline.models.model import Model
from pipeline.models.parameter import TwinRole
from pipeline.run import MotionError
from pipeline.sources import Vehicle
from pipeline.sources.configuration import GIVE_GEOMETRY

CREEP_S = 0.01
"""Time constant of wheels with little creep [s]: five time steps of 2 ms, where three are stable, too."""
GRIP = 50.0
"""Friction coefficient of wheels that do not slide: above all forces in driving, so that only creep acts."""
USUAL_MASS_KG = 30.0
"""Mass if unknown [kg]: creep is proportional to it, so that the motion does not depend on it."""
WHEEL_SHARE = 0.05
"""Mass of a wheel relative to that of the vehicle, unless wheels alone turn as hard as the model."""
_LEAST_CHASSIS = 0.1
"""Share of the chassis in the moment of inertia about the vertical axis, at least."""
_LEAST_SCRUB = 1.2
"""Minimum ratio of effective to nominal track for two axles: below it creep is mostly sideways."""
_FLAT = 0.6
"""Ratio of moments of inertia about the horizontal and the vertical axes, as of a flat box."""
_IN_SERVOS = frozenset(
    {
        TwinRole.WHEEL_LIMIT,
        TwinRole.SPEED_LAG,
        TwinRole.SIDE_LAGS,
        TwinRole.SPEED_GAIN,
        TwinRole.SIDE_GAIN,
        TwinRole.STEERING_LAG,
        TwinRole.STEERING_GAIN,
        TwinRole.STEERING_OFFSET,
    }
)
_OF_SLIDING = frozenset({TwinRole.TRACK, TwinRole.CREEP})
Side = Literal["left", "right"]


@dataclass(frozen=True)
class TwinWheel:
    """Wheel of a twin.

    Attributes:
        name: for example `front_left`.
        side: side of the vehicle.
        x_m, y_m: its centre, from base_link.
        radius_m: effective radius.
        aside_nspm, along_nspm: force over creep speed along the axle and across it [N s/m].
        is_driven, is_steered: function of its joints.
    """

    name: str
    side: Side
    x_m: float
    y_m: float
    radius_m: float
    aside_nspm: float
    along_nspm: float
    is_driven: bool = True
    is_steered: bool = False


@dataclass(frozen=True)
class TwinServo:
    """Response of a joint to its command: a first-order lag, a gain, and an offset [rad] of steering."""

    lag_s: float = 0.0
    gain: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class TwinBody:
    """Body of a twin on wheels with creep, with its controller and servos.

    Attributes:
        vehicle: the vehicle.
        mass_kg: total mass.
        turning_inertia_kgm2: total moment of inertia about the vertical axis.
        centre_m: x and y of its centre of mass, and of its wheels, from base_link.
        track_m, wheelbase_m: distances between the centres of its wheels.
        wheels: the wheels.
        grip: friction coefficient of the wheels.
        castors_m: x and y of castors without friction, from base_link.
        servos: servos of the sides, or of a car's axle, which is the same for both.
        steering: steering servo of a car; None on others.
        delay_s: dead time between a command and the servos.
        wheel_limit_radps: largest wheel speed that a servo accepts; infinite without a limit.
        creep_s: delay of the body behind its wheels; subtracted from the servos.
        slides: whether this delay is part of the model, so that the body has a state of its own.
        controller: effects between command and servos without an element in a simulator.
        reported: effects of the localization, which are not part of a body.
        missing: effects that wheel contacts cannot reproduce.
        notes: assumptions, one per line.
    """

    vehicle: Vehicle
    mass_kg: float
    turning_inertia_kgm2: float
    centre_m: tuple[float, float]
    track_m: float
    wheelbase_m: float
    wheels: tuple[TwinWheel, ...]
    grip: float
    castors_m: tuple[tuple[float, float], ...]
    servos: Mapping[Side, TwinServo]
    steering: TwinServo | None
    delay_s: float
    wheel_limit_radps: float
    creep_s: float
    slides: bool
    controller: tuple[Effect, ...]
    reported: tuple[Effect, ...]
    missing: tuple[Effect, ...]
    notes: tuple[str, ...]

    @property
    def flat_inertia_kgm2(self) -> float:
        """Moment of inertia about a horizontal axis."""
        return _FLAT * self.turning_inertia_kgm2


def build_twin_body(model: Model, speed_mps: float = 1.0) -> TwinBody:
    """Build the body that moves like a model.

    Args:
        model: a fitted model.
        speed_mps: speed at which the creep of sliding wheels and a car's understeer are matched: the former
            grows with speed in the model, the latter with its square.

    Raises:
        MotionError: ``wrong_vehicle``: rollers have no twin yet; ``no_geometry``: dimensions are not its own;
            ``absurd_number``.
    """
    require_factors(model)
    vehicle = model.vehicle
    if vehicle.stand_ins:
        what = f"a twin needs {' and '.join(vehicle.stand_ins)}, which are not known"
        raise MotionError("no_geometry", what, where=vehicle.id, hint=GIVE_GEOMETRY)
    return _Builder(model, speed_mps).build()


class _Builder:
    def __init__(self, model: Model, speed_mps: float) -> None:
        self.model = model
        self.vehicle = model.vehicle
        self.effects = {effect.twin: effect for effect in model.effects if effect.twin}
        self.sliding = self.effects.get(TwinRole.SLIDING)
        self.speed_mps = speed_mps
        self.notes: list[str] = []
        kinds = ("differential", "ackermann")
        if self.vehicle.kind not in kinds:
            what = (
                f"a twin exists of {' and '.join(kinds)} vehicles; {self.vehicle.id} is {self.vehicle.kind}"
            )
            hint = "Export to another target: json and python take every vehicle."
            raise MotionError("wrong_vehicle", what, where=self.vehicle.id, hint=hint)
        self.is_car = self.vehicle.kind == "ackermann"
        self.mass_kg = self.vehicle.mass_kg or USUAL_MASS_KG
        if self.vehicle.mass_kg is None:
            self.notes.append(f"mass {USUAL_MASS_KG:g} kg is assumed: the motion does not depend on it")

    def build(self) -> TwinBody:
        track, wheelbase = self._lay_out()
        aside, along = self._find_creep(track, wheelbase)
        wheels = self._lay_out_wheels(track, wheelbase, aside, along)
        centre = (self._value(TwinRole.CENTRE_AHEAD), self._value(TwinRole.CENTRE_ASIDE))
        inertia = along * sum(
            wheel.along_nspm * (wheel.y_m - centre[1]) ** 2 * wheel.is_driven
            + wheel.aside_nspm * (wheel.x_m - self._middle(centre, wheelbase)) ** 2
            for wheel in wheels
        )
        if self.sliding and self.sliding.values["gyration"] > 0.0:
            inertia = self.mass_kg * (0.5 * self.sliding.values["gyration"] * track) ** 2
        controller, servos, steering = self._split_drive()
        effects = self.model.effects
        late = along - min(self._find_inertia(), along)
        delay = self._value(TwinRole.DELAY)
        shortened = {side: TwinServo(max(one.lag_s - late, 0.0), one.gain) for side, one in servos.items()}
        rest = max(late - min(one.lag_s for one in servos.values()), 0.0)
        return TwinBody(
            vehicle=self.vehicle,
            mass_kg=self.mass_kg,
            turning_inertia_kgm2=inertia,
            centre_m=(self._middle(centre, wheelbase), centre[1]),
            track_m=track,
            wheelbase_m=wheelbase,
            wheels=wheels,
            grip=min(self.sliding.values["friction"], GRIP) if self.sliding else GRIP,
            castors_m=self._lay_out_castors(track, wheelbase, centre),
            servos=shortened,
            steering=steering,
            delay_s=max(delay - rest, 0.0),
            wheel_limit_radps=self._find_wheel_limit(controller),
            creep_s=late,
            slides=TwinRole.CREEP in self.effects or self.sliding is not None,
            controller=controller,
            reported=tuple(e for e in effects if e.place is Place.LOCALIZATION),
            missing=tuple(
                e for e in effects if Place.DRIVE < e.place < Place.LOCALIZATION and not self._is_in_body(e)
            ),
            notes=tuple(self.notes),
        )

    def _value(self, role: TwinRole, name: str = "") -> float:
        """Parameter of the effect of that role, by default its first one; zero if there is none."""
        if role not in self.effects:
            return 0.0
        values = self.effects[role].values
        return values[name or next(iter(values))]

    def _is_in_body(self, effect: Effect) -> bool:
        """Whether the body has a number for an effect; where wheels slide, creep and track are theirs."""
        return effect.twin is not None and not (self.sliding and effect.twin in _OF_SLIDING)

    def _find_inertia(self) -> float:
        """Time constant by which the body follows its wheels in the model [s]; zero without one."""
        if self.sliding:
            return self.sliding.values["creep"] * self.speed_mps / GRAVITY_MPS2
        return self._value(TwinRole.CREEP)

    def _middle(self, centre: tuple[float, float], wheelbase: float) -> float:
        """X of the centre of mass: between the axles of a car, otherwise of the wheels."""
        rear = centre[0] - self.vehicle.base_to_rear_axle_m
        return rear + 0.5 * wheelbase if self.is_car else centre[0]

    def _lay_out(self) -> tuple[float, float]:
        """Distance between the sides and between the axles of the contacts [m]; zero for one axle."""
        nominal, wheelbase = self.vehicle.track_width_m, self.vehicle.wheelbase_m
        if self.is_car:
            wheelbase = (wheelbase or 1.0) * (self._value(TwinRole.WHEELBASE) or 1.0)
            if nominal is None:
                nominal = 0.6 * wheelbase
                self.notes.append(f"track width {nominal:.3g} m is assumed: the motion does not depend on it")
            return nominal, wheelbase
        if nominal is None:
            what = "the track width of the vehicle is not known, so its wheels have no place"
            hint = "Give track_width_m under [vehicle] of the model file."
            raise MotionError("no_geometry", what, where=self.vehicle.id, hint=hint)
        if self.sliding:
            aside, along = self._find_creep(nominal, nominal)
            between = nominal * math.sqrt((self.sliding.values["k"] - 1.0) * aside / along)
            self.notes.append(f"the axles stand {between:.4g} m apart, as the turns of the model require")
            return nominal, between
        effective = nominal * (self._value(TwinRole.TRACK) or 1.0)
        if wheelbase is None:
            if effective != nominal:
                self.notes.append(f"the driven wheels stand {effective:.4g} m apart: the effective track")
            return effective, 0.0
        if effective < _LEAST_SCRUB * nominal:
            self.notes.append("its wheels stand on one axle: on two they would not turn it so easily")
            return effective, 0.0
        width, room = nominal, effective**2 - 4.0 * wheelbase**2
        if TwinRole.CREEP in self.effects and room > 0.0:
            # With equal creep in both directions, the wheels follow equally late in all directions.
            width = 0.5 * (effective + math.sqrt(room))
            apart = f"{width:.3g} m apart, not {nominal:.3g} m"
            self.notes.append(f"the wheels stand {apart}: so they creep alike along and across")
        return width, wheelbase

    def _find_creep(self, track: float, wheelbase: float) -> tuple[float, float]:
        """Time constants of creep [s]: lateral and longitudinal."""
        skid, inertia = self._value(TwinRole.CREEP_ASIDE), self._find_inertia()
        if self.sliding:
            return max(inertia + skid, CREEP_S), max(inertia, CREEP_S)
        aside = max(skid, inertia, CREEP_S)
        if self.is_car or wheelbase == 0.0:
            return aside, max(inertia, CREEP_S)
        effective = (self.vehicle.track_width_m or 1.0) * (self._value(TwinRole.TRACK) or 1.0)
        share = (effective / track - 1.0) * (track / wheelbase) ** 2
        if inertia > 0.0:
            inertia = max(inertia, CREEP_S)
            return inertia / share, inertia
        return aside, aside * share

    def _lay_out_wheels(
        self, track: float, wheelbase: float, aside: float, along: float
    ) -> tuple[TwinWheel, ...]:
        x, y = self._value(TwinRole.CENTRE_AHEAD), self._value(TwinRole.CENTRE_ASIDE)
        axles = {"front": 0.5 * wheelbase, "rear": -0.5 * wheelbase} if wheelbase else {"drive": 0.0}
        if self.is_car:
            x -= self.vehicle.base_to_rear_axle_m
            axles = {"front": wheelbase, "rear": 0.0}
        radius = self.vehicle.wheel_radius_m * (self._value(TwinRole.RADIUS) or 1.0)
        uneven = 0.5 * self._value(TwinRole.RADIUS_DIFFERENCE)
        share = self.mass_kg / (2 * len(axles))
        wheels = []
        for axle, ahead in axles.items():
            steers = self.is_car and axle == "front"
            growth = self._value(TwinRole.CREEP_OF_STEERED) if steers else 0.0
            lateral = aside + max(growth * self.speed_mps, 0.0)
            driven = len(axles) if not self.is_car else 1
            # The driven wheels move the whole mass forward.
            forward = share * len(axles) / driven / along
            wheels += [
                TwinWheel(
                    f"{axle}_{side}", side, x + ahead, y + sign * 0.5 * track, radius * (1.0 - sign * uneven),
                    share / lateral, forward, not steers, steers,
                )
                for side, sign in _SIDES
            ]  # fmt: skip
        return tuple(wheels)

    def _lay_out_castors(
        self, track: float, wheelbase: float, centre: tuple[float, float]
    ) -> tuple[tuple[float, float], ...]:
        if wheelbase:
            return ()
        self.notes.append("it stands on castors without friction before and behind its axle")
        return tuple((centre[0] + sign * 0.5 * track, centre[1]) for sign in (1.0, -1.0))

    def _split_drive(self) -> tuple[tuple[Effect, ...], dict[Side, TwinServo], TwinServo | None]:
        """Effects of the controller, and the servos, which cover the effects at the end of the drivetrain."""
        drive = [e for e in self.model.effects if e.place is Place.DRIVE]
        steers = [e for e in drive if e.id.startswith("steering_")]
        before = [*_cut_servos(e for e in drive if e not in steers), *_cut_servos(steers)]
        in_servos = {e.twin for e in drive if e not in before}
        commanded = [
            e for e in self.model.effects if e.place is Place.COMMAND and e.twin is not TwinRole.DELAY
        ]

        def take(role: TwinRole, neutral: float = 0.0, name: str = "") -> float:
            return self._value(role, name) if role in in_servos else neutral

        gain, uneven = take(TwinRole.SPEED_GAIN, 1.0), 0.5 * take(TwinRole.SIDE_GAIN)
        lag = take(TwinRole.SPEED_LAG)
        servos: dict[Side, TwinServo] = {
            side: TwinServo(lag + take(TwinRole.SIDE_LAGS, name=f"tau_{side}"), gain * (1.0 - sign * uneven))
            for side, sign in _SIDES
        }
        if lag and TwinRole.SIDE_LAGS in in_servos:
            self.notes.append("two lags one after the other are added up to one")
        steering = None
        if self.is_car:
            steering = TwinServo(
                max(take(TwinRole.STEERING_LAG) - CREEP_S, 0.0),
                take(TwinRole.STEERING_GAIN, 1.0),
                take(TwinRole.STEERING_OFFSET) + self._value(TwinRole.STEERING_MOUNT),
            )
        return (*commanded, *before), servos, steering

    def _find_wheel_limit(self, controller: Iterable[Effect]) -> float:
        known = TwinRole.WHEEL_LIMIT in self.effects
        if not known or any(effect.twin is TwinRole.WHEEL_LIMIT for effect in controller):
            return math.inf
        return self._value(TwinRole.WHEEL_LIMIT)


_SIDES: tuple[tuple[Side, float], ...] = (("left", 1.0), ("right", -1.0))


def _cut_servos(effects: Iterable[Effect]) -> list[Effect]:
    """Effects upstream of the servos: all up to the last effect that no servo covers.

    A servo limits its command: effects upstream of a limit remain in the controller.
    """
    chain = list(effects)
    while chain and chain[-1].twin in _IN_SERVOS:
        if chain.pop().twin is TwinRole.WHEEL_LIMIT:
            break
    return chain


def weigh_wheel(wheel: TwinWheel, body: TwinBody) -> tuple[float, float, float]:
    """Mass of a wheel, and its moments of inertia about its axle and across it, as for a tyre."""
    x, y = body.centre_m
    # Moment of inertia of all wheels about the vertical axis over the mass of one.
    turning = sum(0.3 * one.radius_m**2 + (one.x_m - x) ** 2 + (one.y_m - y) ** 2 for one in body.wheels)
    mass = min(WHEEL_SHARE * body.mass_kg, (1.0 - _LEAST_CHASSIS) * body.turning_inertia_kgm2 / turning)
    spin = 0.5 * mass * wheel.radius_m**2
    return mass, spin, 0.6 * spin


def weigh_chassis(body: TwinBody) -> tuple[float, tuple[float, float], float]:
    """Mass, flat and turning moments of inertia of the body without wheels, and the height of its centre.

    The height puts the total centre of mass on the ground: creep has no limit, and would tip anything higher.
    """
    height = max(wheel.radius_m for wheel in body.wheels)
    wheels = [(wheel, *weigh_wheel(wheel, body)) for wheel in body.wheels]
    mass = body.mass_kg - sum(weight for _, weight, _, _ in wheels)
    low = -height * body.mass_kg / mass
    x, y = body.centre_m
    turning = body.turning_inertia_kgm2 - sum(
        across + weight * ((wheel.x_m - x) ** 2 + (wheel.y_m - y) ** 2) for wheel, weight, _, across in wheels
    )
    return mass, (max(body.flat_inertia_kgm2, 0.5 * turning), turning), low
