"""Logs of platforms that speak protobuf: the same sheets as messages of their types.

Types as farm-ng/farm-ng-core and farm-ng/farm-ng-amiga declare them; enumerations stand as the numbers that
they are in a message.
"""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from pipeline.simulate.messages import Sheet
from pipeline.simulate.scenario import Clock
from pipeline.simulate.stamps import stamp_times

_CORE, _CANBUS, _FILTER = "farm_ng.core.proto", "farm_ng.canbus.proto", "farm_ng.filter.proto"
TYPES: Final[dict[str, str]] = {
    f"{_CORE}.Vec3F64": "double x = 1; double y = 2; double z = 3",
    f"{_CORE}.QuaternionF64": f"{_CORE}.Vec3F64 imag = 1; double real = 2",
    f"{_CORE}.Rotation3F64": f"{_CORE}.QuaternionF64 unit_quaternion = 1",
    f"{_CORE}.Isometry3F64": f"{_CORE}.Rotation3F64 rotation = 1; {_CORE}.Vec3F64 translation = 2",
    f"{_CORE}.Pose": f"{_CORE}.Isometry3F64 a_from_b = 1; string frame_a = 2; string frame_b = 3; "
    f"{_CORE}.Vec3F64 linvel_of_a_in_b = 4; {_CORE}.Vec3F64 angvel_of_a_in_a = 5",
    f"{_CANBUS}.Twist2d": "float linear_velocity_x = 1; float linear_velocity_y = 2; "
    "float angular_velocity = 3",
    f"{_CANBUS}.AmigaTpdo1": "uint32 node_id = 1; double stamp = 2; int32 control_state = 3; "
    "double measured_speed = 4; double measured_angular_rate = 5; uint32 pto_bits = 6; "
    "uint32 hbridge_bits = 7",
    f"{_CANBUS}.AmigaV6CanbusState": f"{_CANBUS}.AmigaTpdo1 amiga_tpdo1 = 1; "
    "double battery_charge_level = 3; bool last_send_error = 4",
    f"{_FILTER}.FilterState": f"{_CORE}.Pose pose = 1; bool has_converged = 2; bool is_calibrated = 3; "
    "double heading = 6",
}
_NUMBERS: Final = {"double": 1, "float": 2, "int32": 5, "bool": 8, "string": 9, "uint32": 13}
_MESSAGE, _OPTIONAL = 11, 1


def is_protobuf(type_name: str) -> bool:
    """Whether a type is one of these."""
    return type_name in TYPES


def write_protobuf(sheets: Sequence[Sheet], clock: Clock, path: Path) -> None:
    """Write sheets as an MCAP log of protobuf messages, in time order."""
    from mcap_protobuf.writer import Writer  # noqa: PLC0415 - heavy

    messages: list[tuple[int, int, Any]] = []
    for number, sheet in enumerate(sheets):
        columns = {
            name: np.broadcast_to(np.asarray(value, dtype=object), sheet.log_s.shape).tolist()
            for name, value in sheet.fields.items()
        }
        for row, time in enumerate(stamp_times(clock, sheet.log_s).tolist()):
            message = _make_classes()[sheet.type_name]()
            for name, column in columns.items():
                _set(message, name, column[row])
            messages.append((time, number, message))
    with path.open("wb") as stream, Writer(stream) as writer:
        for time, number, message in sorted(messages, key=lambda one: one[:2]):
            writer.write_message(sheets[number].topic, message, time, time)


def _set(message: Any, path: str, value: object) -> None:  # noqa: ANN401 - made at run time
    *inner, name = path.split(".")
    for part in inner:
        message = getattr(message, part)
    kind = message.DESCRIPTOR.fields_by_name[name].cpp_type
    whole = isinstance(value, float) and kind not in {5, 6}
    setattr(message, name, int(value) if whole else value)  # type: ignore[call-overload]


@cache
def _make_classes() -> dict[str, Any]:
    """A class for every type."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory  # type: ignore[import-untyped]  # noqa: PLC0415 - heavy

    pool = descriptor_pool.DescriptorPool()
    for package in (_CORE, _CANBUS, _FILTER):
        file = descriptor_pb2.FileDescriptorProto(name=f"{package}.proto", package=package, syntax="proto3")
        file.dependency.extend([] if package == _CORE else [f"{_CORE}.proto"])
        for name, text in TYPES.items():
            if name.rpartition(".")[0] != package:
                continue
            declared = file.message_type.add(name=name.rpartition(".")[2])
            for line in text.split("; "):
                kind, field, _, number = line.split(" ")
                plain = kind in _NUMBERS
                declared.field.add(
                    name=field,
                    number=int(number),
                    label=_OPTIONAL,
                    type=_NUMBERS.get(kind, _MESSAGE),
                    type_name=None if plain else f".{kind}",
                )
        pool.Add(file)
    return {name: message_factory.GetMessageClass(pool.FindMessageTypeByName(name)) for name in TYPES}
