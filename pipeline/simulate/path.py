"""From wheels to body velocity, and on to the pose: over a plane or hills."""

import math
from dataclasses import dataclass

import numpy as np

from pipeline.core import (
    GRAVITY_MPS2,
    Floats,
    multiply_quaternions,
    quaternions_from_euler,
    quaternions_from_yaw,
    rotate,
)
from pipeline.simulate.drivetrain import TURNING_MPS, move_by_corners, steer_tyres
from pipeline.simulate.facts import Effects, SimulateError, Vehicle
from pipeline.simulate.programs import filter_pole, lag_signal, make_coloured_noise, walk_in_plane
from pipeline.simulate.scenario import (
    BodyMotion,
    Disturbance,
    Drive,
    ExtraPhysics,
    Ground,
    State,
    integrate_cells,
)

# From wheels to body velocity: rolling, then inertia and ground effects in parallel, then rotation centres.
#
# What depends on the place or the slope is added while the pose is integrated.


def move_body(
    drive: Drive,
    vehicle: Vehicle,
    effects: Effects,
    *,
    disturbance: Disturbance,
    generator: np.random.Generator,
) -> BodyMotion:
    """Body velocity of the drive's wheels.

    Args:
        drive: true wheel speeds and steering.
        vehicle: geometry.
        effects: which effects act.
        disturbance: random true motion, on top.
        generator: source of the disturbance.
    """
    v0, s0, w0 = _roll_wheels(drive, vehicle, effects)
    rim = vehicle.wheel_radius_m * np.maximum(np.abs(drive.left), np.abs(drive.right))
    if drive.corners is not None:
        rim = vehicle.wheel_radius_m * np.max(np.abs(list(drive.corners.values())), axis=0)
    turning = (rim > TURNING_MPS).astype(np.float64)
    v_x, v_y, v_w = v0, s0, w0
    if effects.is_active("tyre_torsion"):
        v_w = _twist_tyres(w0, effects, drive.step_s)
    if effects.is_active("body_inertia"):
        v_x, v_y, v_w = _apply_inertia(v0, s0, w0, effects.value("body_inertia", "tau"), drive.step_s)
    if effects.is_active("contact_friction"):
        v_x, v_y, v_w = _slide_on_contacts(v0, w0, vehicle.track_width_m, effects, drive.step_s)
    # Friction in contact contains the ratio of yaw rates, as the track does.
    along, aside, yaw_rate = (v_x, v_y, v_w) if effects.is_active("contact_friction") else (v0, s0, w0)
    v_x = (
        v_x
        - effects.value("speed_slip", "k") * along * np.abs(along)
        - effects.value("turning_resistance", "k") * along * np.abs(yaw_rate)
    )
    v_y = (
        v_y
        - effects.value("lateral_skid", "c") * along * yaw_rate
        + effects.value("lateral_drift", "c") * turning
    )
    if vehicle.moves_sideways:
        v_x = v_x + effects.value("lateral_skid", "c") * aside * yaw_rate
        v_y = v_y - effects.value("roller_slip", "k") * aside * np.abs(aside)
        v_y = v_y + effects.value("lateral_pull", "c") * v_x
    v_w = (
        v_w
        + effects.value("speed_track", "k") * np.abs(along) * yaw_rate
        + effects.value("yaw_drift", "c") * turning
        + effects.value("yaw_pull", "c") * v_x
    )
    shaken = _shake(disturbance, turning, drive.step_s, generator)
    v_x, v_y, v_w = v_x + shaken[0], v_y + shaken[1], v_w + shaken[2]
    v_y = v_y - effects.value("icr_offset", "x_icr") * v_w
    v_x = v_x + effects.value("icr_lateral", "y_icr") * v_w
    return BodyMotion(v0, w0, np.stack((v_x, v_y, v_w), axis=1), turning)


def _roll_wheels(drive: Drive, vehicle: Vehicle, effects: Effects) -> tuple[Floats, Floats, Floats]:
    radius = vehicle.wheel_radius_m * effects.value("wheel_radius", "k")
    uneven = 0.5 * effects.value("wheel_asymmetry", "e")
    left = radius * (1.0 - uneven) * drive.left
    right = radius * (1.0 + uneven) * drive.right
    v0 = 0.5 * (left + right)
    s0 = np.zeros_like(v0)
    if drive.corners is not None:
        radii = {
            corner: radius * (1.0 + uneven * (1 if "right" in corner else -1)) for corner in drive.corners
        }
        rims = {
            corner: radii[corner] / vehicle.wheel_radius_m * wheel for corner, wheel in drive.corners.items()
        }
        v0, s0, w0 = move_by_corners(vehicle, rims)
        s0, w0 = s0 * effects.value("lateral_scale", "k"), w0 / effects.value("effective_track", "k")
    elif vehicle.kind == "ackermann":
        span = (
            vehicle.wheelbase_m * effects.value("effective_wheelbase", "k")
            + effects.value("understeer", "K") * v0**2
        )
        w0 = v0 * np.tan(steer_tyres(drive.steering, effects)) / span
    else:
        w0 = (right - left) / (vehicle.track_width_m * effects.value("effective_track", "k"))
    time = (np.arange(v0.size) + 0.5) * drive.step_s
    duration = v0.size * drive.step_s
    fade = 1.0 - effects.value("time_drift", "k") * time / duration
    gain_v, gain_w = fade, fade
    if effects.is_active("terrain_change") and np.isnan(effects.value("terrain_change", "at_x")):
        at = effects.value("terrain_change", "at_s")
        beyond = time >= (0.5 * duration if np.isnan(at) else at)
        gain_v = fade * np.where(beyond, effects.value("terrain_change", "k_v"), 1.0)
        gain_w = fade * np.where(beyond, effects.value("terrain_change", "k_w"), 1.0)
    return v0 * gain_v, s0 * gain_v, w0 * gain_w


def _apply_inertia(
    v0: Floats, s0: Floats, w0: Floats, tau_s: float, step_s: float
) -> tuple[Floats, Floats, Floats]:
    # In a frame that does not turn, the two equations of v_x and v_y are one linear lag of a complex number.
    turning = lag_signal(w0, tau_s=tau_s, step_s=step_s)
    heading = integrate_cells(turning, step_s=step_s)
    middle = np.exp(0.5j * (heading[:-1] + heading[1:]))
    decay = float(np.exp(-step_s / tau_s))
    drive = (v0 + 1j * s0) * middle * (1.0 - decay)
    at_end = filter_pole(drive.real, decay) + 1j * filter_pole(drive.imag, decay)
    fixed = 0.5 * (at_end + np.concatenate(([0.0], at_end[:-1])))
    turned = fixed * np.conj(middle)
    return turned.real, turned.imag, turning


def _twist_tyres(w0: Floats, effects: Effects, step_s: float) -> Floats:
    """Yaw rate of a body on the springs and dampers of its tyres, by short steps, rates first."""
    tau, damping = (effects.value("tyre_torsion", name) for name in ("tau", "damping"))
    stiffness = 1.0 / tau**2
    friction = 2.0 * (0.2 if math.isnan(damping) else damping) / tau
    short, rate, twist = step_s / _TWIST_STEPS, float(w0[0]), 0.0
    yaw_rate = np.empty(w0.size)
    for cell, wheels in enumerate(w0.tolist()):
        total = 0.0
        for _ in range(_TWIST_STEPS):
            before = rate
            rate += short * (stiffness * twist + friction * (wheels - rate))
            twist += short * (wheels - rate)
            total += 0.5 * (before + rate)
        yaw_rate[cell] = total / _TWIST_STEPS
    return yaw_rate


def _slide_on_contacts(
    v0: Floats, w0: Floats, track_m: float, effects: Effects, step_s: float
) -> tuple[Floats, Floats, Floats]:
    # Velocities and forces are complex numbers in the body's frame; classical Runge-Kutta steps of 2 ms.
    names = ("friction", "creep", "k", "gyration")
    friction, creep, k, gyration = (effects.value("contact_friction", name) for name in names)
    half = 0.5 * track_m
    ahead, squared = half * math.sqrt(k - 1.0), (half * gyration) ** 2
    contacts = [complex(ahead * end, half * side) for end in (1, -1) for side in (1, -1)]

    def push(contact: complex, velocity: complex, yaw_rate: float, sides: tuple[float, float]) -> complex:
        u = sides[contact.imag < 0.0]
        slip = u - velocity - 1j * yaw_rate * contact
        # Of a wheel at rest the slip ratio is that at 0.1 m/s.
        least = friction * creep * math.hypot(u, 0.1)
        return 0.25 * GRAVITY_MPS2 * friction * slip / math.hypot(abs(slip), least)

    def accelerate(velocity: complex, yaw_rate: float, sides: tuple[float, float]) -> tuple[complex, float]:
        pushes = [push(one, velocity, yaw_rate, sides) for one in contacts]
        torques = [(one.conjugate() * force).imag for one, force in zip(contacts, pushes, strict=True)]
        return sum(pushes) - 1j * yaw_rate * velocity, sum(torques) / squared

    count = max(1, math.ceil(step_s / 2e-3))
    short = step_s / count
    velocity, yaw_rate, rows = 0j, 0.0, []
    for along, turn in zip(v0.tolist(), (half * w0).tolist(), strict=True):
        sides, total, turned = (along - turn, along + turn), 0j, 0.0
        for _ in range(count):
            a, alpha = accelerate(velocity, yaw_rate, sides)
            b, beta = accelerate(velocity + 0.5 * short * a, yaw_rate + 0.5 * short * alpha, sides)
            c, gamma = accelerate(velocity + 0.5 * short * b, yaw_rate + 0.5 * short * beta, sides)
            d, delta = accelerate(velocity + short * c, yaw_rate + short * gamma, sides)
            before, rate_before = velocity, yaw_rate
            velocity += short / 6.0 * (a + 2.0 * b + 2.0 * c + d)
            yaw_rate += short / 6.0 * (alpha + 2.0 * beta + 2.0 * gamma + delta)
            total, turned = total + 0.5 * (before + velocity), turned + 0.5 * (rate_before + yaw_rate)
        rows.append((total.real / count, total.imag / count, turned / count))
    v_x, v_y, v_w = np.array(rows).reshape(-1, 3).T
    return v_x, v_y, v_w


def _shake(
    disturbance: Disturbance, turning: Floats, step_s: float, generator: np.random.Generator
) -> tuple[Floats, Floats, Floats]:
    def draw(deviation: float) -> Floats:
        if deviation == 0.0:
            return np.zeros_like(turning)
        return turning * make_coloured_noise(
            generator,
            size=turning.size,
            deviation=deviation,
            correlation_s=disturbance.correlation_s,
            step_s=step_s,
        )

    return draw(disturbance.speed_mps), draw(disturbance.speed_mps), draw(disturbance.turn_radps)


_TWIST_STEPS = 10
"""Steps within a cell in which the yaw swings on its tyres: none is longer than a hundredth of a swing."""
_SLOW_STEP_S = 0.005


@dataclass(frozen=True)
class Path:
    """The true motion.

    Attributes:
        time_s: cell edges [s], shape (n + 1,).
        position: base_link in the world [m], shape (n + 1, 3).
        quaternion: attitude, shape (n + 1, 4).
        velocity: body velocity (v_x, v_y, v_w) in each cell, shape (n, 3).
    """

    time_s: Floats
    position: Floats
    quaternion: Floats
    velocity: Floats


Vector = tuple[float, float, float]

SLOPE_EFFECTS = {
    "slope_slip": "k",
    "slope_creep": "c",
    "side_slope_slip": "k",
    "side_slope_creep": "c",
    "side_slope_turn": "k",
}
"""Effects by which gravity moves the body on a slope, with their parameters."""
_WAVES = 6


@dataclass(frozen=True)
class Surface:
    """Height h(x, y) = slope_x x + slope_y y + sum of a sin(p x + q y + c).

    Attributes:
        slope_x, slope_y: gradient of the plane.
        waves: (a [m], p [1/m], q [1/m], c [rad]) of each wave.
    """

    slope_x: float
    slope_y: float
    waves: tuple[tuple[float, float, float, float], ...]

    def height_at(self, x: float, y: float) -> float:
        """Height [m] of the ground at a place [m]."""
        hills = sum(size * math.sin(p * x + q * y + phase) for size, p, q, phase in self.waves)
        return self.slope_x * x + self.slope_y * y + hills

    def normal_at(self, x: float, y: float) -> Vector:
        """Unit normal of the ground at a place [m], pointing up."""
        slope_x, slope_y = self.slope_x, self.slope_y
        for size, p, q, phase in self.waves:
            change = size * math.cos(p * x + q * y + phase)
            slope_x += change * p
            slope_y += change * q
        scale = 1.0 / math.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
        return -slope_x * scale, -slope_y * scale, scale


def make_surface(ground: Ground, generator: np.random.Generator) -> Surface:
    """Draw the hills of a ground; wavelengths spread by a factor of two about the asked one."""
    up_x, up_y, up_z = rotate(ground.tilt, np.array([0.0, 0.0, 1.0])).tolist()
    waves: list[tuple[float, float, float, float]] = []
    if ground.hill_m > 0.0:
        size = ground.hill_m * math.sqrt(2.0 / _WAVES)
        directions = generator.uniform(0.0, math.pi, _WAVES).tolist()
        stretches = (2.0 ** generator.uniform(-0.5, 0.5, _WAVES)).tolist()
        phases = generator.uniform(0.0, 2.0 * math.pi, _WAVES).tolist()
        for direction, stretch, phase in zip(directions, stretches, phases, strict=True):
            number = 2.0 * math.pi / (ground.hill_length_m * stretch)
            waves.append((size, number * math.cos(direction), number * math.sin(direction), phase))
    return Surface(-up_x / up_z, -up_y / up_z, tuple(waves))


def integrate_path(
    motion: BodyMotion,
    drive: Drive,
    effects: Effects,
    *,
    ground: Ground,
    extra: ExtraPhysics | None,
    start: tuple[float, float, float],
    generator: np.random.Generator,
) -> Path:
    """Drive the body over the ground.

    Args:
        motion: velocities before slope and place act.
        drive: wheels, for odd physics that looks at them.
        effects: those of `SLOPE_EFFECTS` and a terrain_change at a place act here.
        ground: shape of the ground.
        extra: odd physics.
        start: x [m], y [m] in the plane and yaw [rad].
        generator: source of the hills.
    """
    is_local = effects.is_active("terrain_change") and math.isfinite(effects.value("terrain_change", "at_x"))
    is_pulled = any(map(effects.is_active, SLOPE_EFFECTS))
    extra = _add_written(effects, extra)
    if extra is None and ground.hill_m == 0.0 and not is_local and not is_pulled:
        return _cross_plane(motion, drive.step_s, ground, start)
    surface = make_surface(ground, generator)
    return _cross_surface(_Walk(motion, drive, effects, extra), surface, ground, start)


def _cross_plane(
    motion: BodyMotion, step_s: float, ground: Ground, start: tuple[float, float, float]
) -> Path:
    tilt = ground.tilt
    velocity = motion.velocity
    heading = start[2] + integrate_cells(velocity[:, 2], step_s=step_s)
    walked = walk_in_plane(velocity[:, 0], velocity[:, 1], heading, step_s=step_s)
    in_plane = np.array([*start[:2], 0.0]) + walked
    time = np.arange(heading.size, dtype=np.float64) * step_s
    quaternion = multiply_quaternions(np.broadcast_to(tilt, (heading.size, 4)), quaternions_from_yaw(heading))
    return Path(time, rotate(tilt, in_plane), quaternion, velocity)


class _Walk:
    """Velocities and wheels averaged onto a slower grid, and what depends on where the body is.

    That is the slope, a terrain's border, odd physics.
    """

    def __init__(
        self, motion: BodyMotion, drive: Drive, effects: Effects, extra: ExtraPhysics | None
    ) -> None:
        stride = max(round(_SLOW_STEP_S / drive.step_s), 1)
        count = motion.v0.size // stride

        def average(signal: Floats) -> Floats:
            means: Floats = signal[: count * stride].reshape(count, stride).mean(axis=1)
            return means

        self.step_s = stride * drive.step_s
        self.velocity = np.stack([average(column) for column in motion.velocity.T], axis=1)
        signals = {"v0": motion.v0, "w0": motion.w0, "left_speed": drive.left, "right_speed": drive.right}
        signals |= {"steering": drive.steering, "turning": motion.turning}
        turned = zip(("left_angle", "right_angle"), drive.wheel_angles(), strict=True)
        self._signals = {name: average(signal).tolist() for name, signal in signals.items()}
        self._signals |= {name: angle[: count * stride : stride].tolist() for name, angle in turned}
        self._slopes = [effects.value(*each) for each in SLOPE_EFFECTS.items()]
        self._centre = effects.value("icr_offset", "x_icr"), effects.value("icr_lateral", "y_icr")
        self._change = [effects.value("terrain_change", name) for name in ("at_x", "k_v", "k_w")]
        self._odd = extra
        self._state = State(dt=self.step_s)

    def push(
        self, index: int, at: tuple[float, float], *, axes: tuple[Vector, Vector], attitude: Vector
    ) -> tuple[float, float, float]:
        """Velocity to add in this cell: d_x [m/s], d_y [m/s], d_w [rad/s]."""
        speed, turning = self._signals["v0"][index], self._signals["turning"][index]
        slip, creep, side_slip, side_creep, side_turn = self._slopes
        border, gain_v, gain_w = self._change
        ahead, aside = -axes[0][2], -axes[1][2]
        d_w = side_turn * aside * speed
        # The centre of rotation stands aside for whatever turns the body.
        d_x = (slip * abs(speed) + creep * turning) * ahead + self._centre[1] * d_w
        d_y = (side_slip * abs(speed) + side_creep * turning) * aside - self._centre[0] * d_w
        if at[0] > border:
            base = self.velocity[index]
            d_x += (gain_v - 1.0) * float(base[0])
            d_w += (gain_w - 1.0) * float(base[2])
        if self._odd is not None:
            state = self._state
            state.t = (index + 0.5) * self.step_s
            state.x, state.y = at
            state.roll, state.pitch, state.yaw = attitude
            for name, signal in self._signals.items():
                setattr(state, name, signal[index])
            odd = self._odd(state)
            d_x, d_y, d_w = d_x + odd[0], d_y + odd[1], d_w + odd[2]
        return d_x, d_y, d_w


def _cross_surface(walk: _Walk, surface: Surface, ground: Ground, start: tuple[float, float, float]) -> Path:
    step, count = walk.step_s, walk.velocity.shape[0]
    tilt = ground.tilt
    x, y, _ = rotate(tilt, np.array([start[0], start[1], 0.0])).tolist()
    ahead_x, ahead_y, ahead_z = rotate(tilt, np.array([math.cos(start[2]), math.sin(start[2]), 0.0])).tolist()
    normal = surface.normal_at(x, y)
    ahead = slide_onto_plane((ahead_x, ahead_y, ahead_z), normal)
    position = np.empty((count + 1, 3))
    angles = np.empty((count + 1, 3))
    velocity = np.empty((count, 3))
    columns = zip(*(column.tolist() for column in walk.velocity.T), strict=True)
    for index, (base_x, base_y, base_w) in enumerate(columns):
        leftward = cross(normal, ahead)
        attitude = _attitude(ahead, leftward, normal)
        position[index] = x, y, surface.height_at(x, y)
        angles[index] = attitude
        d_x, d_y, d_w = walk.push(index, (x, y), axes=(ahead, leftward), attitude=attitude)
        v_x, v_y, v_w = base_x + d_x, base_y + d_y, base_w + d_w
        velocity[index] = v_x, v_y, v_w
        half_c, half_s = math.cos(0.5 * v_w * step), math.sin(0.5 * v_w * step)
        along, across = v_x * half_c - v_y * half_s, v_x * half_s + v_y * half_c
        x += step * (along * ahead[0] + across * leftward[0])
        y += step * (along * ahead[1] + across * leftward[1])
        cosine, sine = math.cos(v_w * step), math.sin(v_w * step)
        turned = (
            ahead[0] * cosine + leftward[0] * sine,
            ahead[1] * cosine + leftward[1] * sine,
            ahead[2] * cosine + leftward[2] * sine,
        )
        normal = surface.normal_at(x, y)
        ahead = slide_onto_plane(turned, normal)
    position[-1] = x, y, surface.height_at(x, y)
    angles[-1] = _attitude(ahead, cross(normal, ahead), normal)
    time = np.arange(count + 1, dtype=np.float64) * step
    quaternion = quaternions_from_euler(angles[:, 0], angles[:, 1], angles[:, 2])
    return Path(time, position, quaternion, velocity)


def _attitude(ahead: Vector, leftward: Vector, normal: Vector) -> Vector:
    """Roll, pitch, yaw [rad] of a body with these axes in the world."""
    pitch = math.asin(max(-1.0, min(1.0, -ahead[2])))
    return math.atan2(leftward[2], normal[2]), pitch, math.atan2(ahead[1], ahead[0])


_FUNCTIONS = {"abs": abs, "min": min, "max": max, **{n: f for n, f in vars(math).items() if n[0] != "_"}}


def _add_written(effects: Effects, extra: ExtraPhysics | None) -> ExtraPhysics | None:
    """Odd physics with the effects that are known by their formulas alone.

    Raises:
        SimulateError: ``bad_formula``, one uses what a `State` does not have.
    """
    if not effects.written:
        return extra
    terms = []
    for spec in effects.written:
        numbers = {one.name: effects.value(spec.id, one.name) for one in spec.parameters}
        for channel, formula in spec.adds.items():
            code = compile(formula, spec.id, "eval")
            if unknown := set(code.co_names) - {*_FUNCTIONS, *numbers, *vars(State())}:
                what = f"{channel} += {formula} uses {', '.join(sorted(unknown))}, which is not simulated"
                hint = f"There are: {', '.join(vars(State()))}"
                raise SimulateError("bad_formula", what, where=spec.id, hint=hint)
            terms.append((("v_x", "v_y", "v_w").index(channel), code, {**_FUNCTIONS, **numbers}))

    def push(state: State) -> tuple[float, float, float]:
        added = [0.0, 0.0, 0.0] if extra is None else [*extra(state)]
        for index, code, known in terms:
            added[index] += eval(code, {"__builtins__": {}}, {**vars(state), **known})  # noqa: S307 - a formula of the program's own catalogue
        return added[0], added[1], added[2]

    return push


def cross(first: Vector, second: Vector) -> Vector:
    """Cross product of two vectors, in plain floats because it runs at every step."""
    (a, b, c), (d, e, f) = first, second
    return b * f - c * e, c * d - a * f, a * e - b * d


def slide_onto_plane(vector: Vector, normal: Vector) -> Vector:
    """The unit vector nearest to ``vector`` that lies in the plane of ``normal``."""
    lift = vector[0] * normal[0] + vector[1] * normal[1] + vector[2] * normal[2]
    x, y, z = (vector[i] - lift * normal[i] for i in range(3))
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    return x * scale, y * scale, z * scale
