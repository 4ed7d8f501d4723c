"""Motion models of the literature by name: sets of effects, and formulas for terms that are not effects.

A model is one entry of `MODELS`, which the screen, model files and comparisons use.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from pipeline.core import GRAVITY_MPS2, guess_names
from pipeline.models.catalogue import find_effect
from pipeline.models.effect import ACKERMANN, ANY, Effect
from pipeline.models.formula import FormulaEffect, make_parameter
from pipeline.models.model import Model
from pipeline.run import MotionError
from pipeline.sources import Vehicle

_STILL_RADPS = 1e-3
"""Added to the difference of wheel speeds [rad/s] before its root is taken, to avoid a zero divisor."""


@dataclass(frozen=True)
class Number:
    """A parameter or constant of a formula.

    Attributes:
        unit: its unit.
        bounds: bounds of a fit.
        start: start value of a fit.
        is_fixed: whether it is a constant that a fit does not change.
        neutral: value at which the formula vanishes; for a constant, the constant itself by default.
        taken_from: attribute of the vehicle that gives its value.
    """

    unit: str
    bounds: tuple[float, float]
    start: float = 0.0
    is_fixed: bool = False
    neutral: float | None = None
    taken_from: str = ""


@dataclass(frozen=True)
class LiteratureModel:
    """A published motion model.

    Attributes:
        name: name for selecting it.
        title: description in one line.
        formula: as published, with the signs and axes of this program.
        source: authors, title and publication.
        link: DOI or arXiv number; empty where there is none.
        kinds: kinds of vehicles it describes.
        effects: ids of its effects.
        terms: formulas by channel, for terms that are not effects.
        numbers: parameters and constants of the formulas.
        needs: required properties of a vehicle beyond its kind, in words; empty for none.
    """

    name: str
    title: str
    formula: tuple[str, ...]
    source: str
    link: str = ""
    kinds: tuple[str, ...] = ("differential",)
    effects: tuple[str, ...] = ()
    terms: Mapping[str, str] = field(default_factory=dict)
    numbers: Mapping[str, Number] = field(default_factory=dict)
    needs: str = ""

    def make(self, vehicle: Vehicle) -> Model:
        """The model of a vehicle with start values of a fit.

        Raises:
            MotionError: ``wrong_vehicle``, it describes other vehicles; ``model_unavailable``, see `needs`.
        """
        hint = f"Choose one of {', '.join(model.name for model in list_models(vehicle))}."
        if vehicle.kind not in self.kinds:
            what = f"it describes {' or '.join(self.kinds)} vehicles; {vehicle.id} is {vehicle.kind}"
            raise MotionError("wrong_vehicle", what, where=self.name, hint=hint)
        if not self.describes(vehicle):
            what = f"it needs {self.needs}, which {vehicle.id} does not say"
            raise MotionError("model_unavailable", what, where=self.name, hint=hint)
        return Model(vehicle, self._make_effects(vehicle))

    def describes(self, vehicle: Vehicle) -> bool:
        """Whether it describes a vehicle, and the vehicle has the properties that it needs."""
        taken = [number.taken_from for number in self.numbers.values() if number.taken_from]
        on_wheels = vehicle.running_gear == "wheels" or not taken
        return vehicle.kind in self.kinds and on_wheels and all(getattr(vehicle, name) for name in taken)

    def count_numbers(self) -> int:
        """Number of parameters that a fit estimates."""
        return sum(len(effect.values) - len(effect.fixed) for effect in self._make_effects(None))

    def _make_effects(self, vehicle: Vehicle | None) -> tuple[Effect, ...]:
        known: tuple[Effect, ...] = tuple(find_effect(name)() for name in self.effects)
        return (*known, self._make_formula(vehicle)) if self.terms else known

    def _make_formula(self, vehicle: Vehicle | None) -> FormulaEffect:
        starts = {
            name: getattr(vehicle, number.taken_from) if vehicle and number.taken_from else number.start
            for name, number in self.numbers.items()
        }
        neutral = {
            name: number.neutral if number.neutral is not None else (starts[name] if number.is_fixed else 0.0)
            for name, number in self.numbers.items()
        }
        parameters = tuple(
            make_parameter(name, number.unit, number.bounds, neutral=neutral[name])
            for name, number in self.numbers.items()
        )
        fixed = [name for name, number in self.numbers.items() if number.is_fixed]
        effect = FormulaEffect(f"{self.name}_terms", self.terms, parameters, fixed=fixed)
        return effect.change(**starts)


def list_models(vehicle: Vehicle) -> list[LiteratureModel]:
    """Published models that describe a vehicle."""
    return [model for model in MODELS if model.describes(vehicle)]


def find_model(name: str) -> LiteratureModel:
    """The model of that name.

    Raises:
        MotionError: ``unknown_model``, with the nearest names.
    """
    known = {model.name: model for model in MODELS}
    if name in known:
        return known[name]
    hint = f"{guess_names(name, known)}`slip model literature` lists them all."
    raise MotionError(
        "unknown_model", f"no model of the literature is called {name!r}", where=name, hint=hint
    )


# Formulas of the velocities at which the friction of four wheels is in balance.
#
# Four wheels carry the same load. All slide, and friction of equal size acts against the slip of each wheel;
# rolling resistance, a share of it, acts against the travel of its side. If the forces and their moment
# balance, the direction of the slip of one side's wheels is independent of the speed: with
# ``g = wheelbase / track`` and ``rolling`` the share,
#
#     sin(delta) = rolling sqrt(1 + g^2),  tan(sigma) = g       both sides travel the same way
#     slip of the inner and outer wheels at sigma - delta and sigma + delta to the axle
#     sin(epsilon) = rolling / sqrt(1 + g^2)                     the sides travel opposite ways
#     slip of all wheels at sigma + epsilon to the axle
#
# The yaw rate is therefore that of a wider track, and the mean of the sides decreases in proportion to the
# yaw rate. Without rolling resistance the track is wider by the factor 1 + g^2 for every motion.

_SQUARE: Final = "(wheelbase / track)^2"
_FREE: Final = f"(1 + {_SQUARE})"
"""Factor by which the track is wider without rolling resistance."""

_LEFT_OVER: Final = f"max(1 - (rolling * {_FREE})^2, 0.01)"
"""Squared share of the friction that remains for turning beside rolling resistance; at least 0.01."""

_WIDER_AHEAD: Final = f"(1 + {_SQUARE} / {_LEFT_OVER})"
_TANGENT: Final = f"rolling / sqrt({_FREE} - rolling^2)"
_WIDER_ON_THE_SPOT: Final = (
    f"(1 + wheelbase / track * (wheelbase / track + {_TANGENT})"
    f" / max(1 - wheelbase / track * {_TANGENT}, 0.1))"
)
_AHEAD: Final = "0.5 * (1 + sign(abs(f_x) - 0.5 * track * abs(f_w)))"
"""One where both sides travel the same way, zero where they travel opposite ways."""

_FRICTION_TERMS: Final = {
    "v_x": (
        f"-sign(f_x) * {_AHEAD} * abs(f_w) / {_WIDER_AHEAD} * 0.5 * wheelbase * rolling * {_FREE}^1.5"
        f" * sqrt(max(1 - rolling^2 * {_FREE}, 0)) / {_LEFT_OVER}"
    ),
    "v_w": f"f_w * ({_AHEAD} / {_WIDER_AHEAD} + (1 - {_AHEAD}) / {_WIDER_ON_THE_SPOT} - 1)",
}
"""Formulas added to the ideal velocity, by channel."""

_SHARE = (-2.0, 2.0)
"""Bounds of published parameters without a range of their own, each in its unit."""
_MANDOW = (
    "A. Mandow, J. L. Martinez, J. Morales, J. L. Blanco, A. Garcia-Cerezo, J. Gonzalez: Experimental "
    "kinematics for wheeled skid-steer mobile robots, IROS 2007"
)
_MANDOW_LINK = "doi:10.1109/IROS.2007.4399139"
_BARIL = (
    "D. Baril, V. Grondin, S.-P. Deschenes, J. Laconte, M. Vaidis, V. Kubelka, A. Gallant, P. Giguere, "
    "F. Pomerleau: Evaluation of skid-steering kinematic models for subarctic environments, CRV 2020"
)
_BARIL_LINK = "arXiv:2004.05131"
_POWERTRAIN = ("transport_delay", "body_speed_limit", "body_turn_limit", "drive_lag")

MODELS: tuple[LiteratureModel, ...] = (
    LiteratureModel(
        "ideal",
        "the ideal model: wheels roll without slip",
        ("v_x = f_x, v_y = 0, v_w = f_w",),
        "B. Siciliano, L. Sciavicco, L. Villani, G. Oriolo: Robotics, Springer 2009, chapter 11",
        "doi:10.1007/978-1-84628-642-1",
        kinds=ANY,
    ),
    LiteratureModel(
        "extended_differential_drive",
        "a differential drive with a wider track than its wheels have",
        ("v_x = f_x, v_w = f_w / k",),
        _MANDOW,
        _MANDOW_LINK,
        effects=("effective_track",),
    ),
    LiteratureModel(
        "icr_symmetric",
        "centres of rotation of both sides at the same distance, one speed factor",
        ("v_x = a f_x, v_w = a b f_w / (2 y_icr)",),
        _MANDOW,
        _MANDOW_LINK,
        effects=("effective_track", "wheel_radius"),
    ),
    LiteratureModel(
        "icr_asymmetric",
        "two lateral and one longitudinal centre of rotation, two speed factors",
        (
            "v_x = (a_r y_l v_r - a_l y_r v_l) / (y_l - y_r)",
            "v_y = -x_icr v_w",
            "v_w = (a_r v_r - a_l v_l) / (y_l - y_r)",
        ),
        _MANDOW,
        _MANDOW_LINK,
        effects=("wheel_asymmetry", "effective_track", "wheel_radius", "icr_lateral", "icr_offset"),
    ),
    LiteratureModel(
        "roc",
        "a track that depends on the radius of curvature",
        ("v_x = f_x", "v_w = f_w / (1 + a / (1 + c sqrt(abs(q)))), q = (left + right) / (right - left)"),
        "T. Wang, Y. Wu, J. Liang, C. Han, J. Chen, Q. Zhao: Analysis and experimental kinematics of a "
        "skid-steering wheeled robot based on a laser scanner sensor, Sensors 15 (2015); compared in "
        f"{_BARIL}",
        "doi:10.3390/s150509681",
        # Multiplied out by the root of the difference, so that driving straight is no division by zero.
        terms={
            "v_w": "f_w / (1 + a * sqrt(abs(right - left) + still)"
            " / (sqrt(abs(right - left) + still) + c * sqrt(abs(left + right)))) - f_w"
        },
        numbers={
            "a": Number("1", (-0.8, 9.0), 0.8),
            "c": Number("1", (0.0, 20.0), 0.1),
            "still": Number("rad/s", (0.0, 1.0), _STILL_RADPS, is_fixed=True),
        },
    ),
    LiteratureModel(
        "full_linear",
        "any linear map of both wheel speeds to the body velocity, 2 x 3",
        ("[v_x, v_y, v_w] = J [left, right]",),
        "G. Anousaki, K. J. Kyriakopoulos: A dead-reckoning scheme for skid-steered vehicles in outdoor "
        f"environments, ICRA 2004; compared in {_BARIL}",
        _BARIL_LINK,
        effects=(
            "wheel_asymmetry",
            "effective_track",
            "wheel_radius",
            "icr_lateral",
            "icr_offset",
            "yaw_misalignment",
        ),
    ),
    LiteratureModel(
        "friction_based",
        "velocities at which friction and rolling resistance of four wheels are in balance",
        (
            "sum of F_i = 0, sum of r_i x F_i = 0",
            "F_i = -mu N_i (s_i / |s_i| + rolling sign(travel of the side)), s_i: slip of a wheel",
            "with equal N_i: v_w = f_w / k, k = 1 + g^2 / (1 - rolling^2 (1 + g^2)^2), g = wheelbase / track",
        ),
        "S. Rabiee, J. Biswas: A friction-based kinematic model for skid-steer wheeled mobile robots, "
        "ICRA 2019; here with the same load on all wheels, where theirs moves with the height of the centre "
        "of mass",
        "doi:10.1109/ICRA.2019.8794216",
        terms=_FRICTION_TERMS,
        numbers={
            "rolling": Number("1", (0.0, 0.3), 0.05),
            "wheelbase": Number("m", (0.0, 25.0), 1.0, is_fixed=True, neutral=0.0, taken_from="wheelbase_m"),
            "track": Number("m", (0.01, 15.0), 1.0, is_fixed=True, taken_from="track_width_m"),
        },
        needs="four wheels, the distance between their axles and between their sides",
    ),
    LiteratureModel(
        "drive",
        "a powertrain with delay, limits and lag, then slip linear in published features",
        (
            "g_x = w1 f_x, g_y = w2 f_x f_w, g_w = w3 f_x f_w + w4 f_x + w5 f_w",
            "v = f - g, f behind delay, limits and lag of the command",
        ),
        "D. Baril, S.-P. Deschenes, L. Coupal, C. Goffin, J. Lepine, P. Giguere, F. Pomerleau: DRIVE: "
        "data-driven robot input vector exploration, ICRA 2024; N. Samson, D. Baril, J. Lepine, "
        "F. Pomerleau: Comparing motion distortion between vehicle field deployments, ICRA workshop 2024",
        "arXiv:2309.10718",
        effects=_POWERTRAIN,
        terms={"v_x": "-w1 * f_x", "v_y": "-w2 * f_x * f_w", "v_w": "-w3 * f_x * f_w - w4 * f_x - w5 * f_w"},
        numbers={
            "w1": Number("1", _SHARE),
            "w2": Number("s", _SHARE),
            "w3": Number("s/m", _SHARE),
            "w4": Number("1/m", _SHARE),
            "w5": Number("1", _SHARE),
        },
    ),
    LiteratureModel(
        "seegmiller",
        "slip linear in specific forces and speeds, gravity and centripetal force together",
        (
            "v_x += (c1 q_x + c2) v0,  q_x = tan(pitch) / cos(roll)",
            "v_y += c3 q_y v0,  q_y = -tan(roll) - v0 w0 / (G cos(pitch) cos(roll))",
            "v_w += c4 q_y v0 + c5 v0 + c6 w0",
        ),
        "N. Seegmiller, A. Kelly: Enhanced 3D kinematic modeling of wheeled mobile robots, RSS 2014",
        terms={
            "v_x": "c1 * tan(pitch) / cos(roll) * v0 + c2 * v0",
            "v_y": "-c3 * (tan(roll) + v0 * w0 / (G * cos(pitch) * cos(roll))) * v0",
            "v_w": "-c4 * (tan(roll) + v0 * w0 / (G * cos(pitch) * cos(roll))) * v0 + c5 * v0 + c6 * w0",
        },
        numbers={
            "c1": Number("1", (-20.0, 20.0)),
            "c2": Number("1", _SHARE),
            "c3": Number("1", (-20.0, 20.0)),
            "c4": Number("1/m", (-20.0, 20.0)),
            "c5": Number("1/m", _SHARE),
            "c6": Number("1", _SHARE),
            "G": Number("m/s^2", (0.0, 100.0), GRAVITY_MPS2, is_fixed=True),
        },
    ),
    LiteratureModel(
        "bicycle_understeer",
        "a bicycle whose curvature falls with the square of its speed",
        ("v_x = f_x, v_w = f_x tan(delta) / (l + K f_x^2)",),
        "T. D. Gillespie: Fundamentals of vehicle dynamics, SAE 1992, chapter 6",
        kinds=ACKERMANN,
        effects=("understeer",),
    ),
    LiteratureModel(
        "kinematic_bicycle_with_lags",
        "a kinematic bicycle whose speed and steering follow late",
        ("tau_v dv/dt = u_v - v, tau_d ddelta/dt = u_d - delta, v_w = v tan(delta) / l",),
        "R. Rajamani: Vehicle dynamics and control, 2nd edition, Springer 2012, chapter 2",
        "doi:10.1007/978-1-4614-1433-9",
        kinds=ACKERMANN,
        effects=("drive_lag", "steering_lag"),
    ),
)
