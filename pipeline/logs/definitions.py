"""Definitions of the standard message types: for writing, and for logs that carry none.

They stand in ``definitions.msg``, as a log's schema puts one type behind the other.
"""

from functools import cache
from importlib import resources
from typing import Final

from pipeline.logs.schema import SIZES, Structure, leaf_paths, parse_msg, short_name

_RULE: Final = f"\n{'=' * 80}\n"


@cache
def _fields() -> dict[str, str]:
    """Fields of every bundled type, one a line, by ``package/Name``."""
    text = resources.files("pipeline.logs").joinpath("definitions.msg").read_text("utf-8")
    sections = (section.partition("\n") for section in text.removesuffix("\n").split(_RULE))
    return {head.removeprefix("MSG: "): fields for head, _, fields in sections}


def definition_text(type_name: str) -> str | None:
    """The concatenated ``ros2msg`` definition of a bundled type, None when it is not bundled.

    Args:
        type_name: ``package/msg/Name`` or ``package/Name``.
    """
    root, fields = short_name(type_name), _fields()
    if root not in fields:
        return None
    order = [root]
    for name in order:
        kinds = [field.split()[0].split("[")[0] for field in fields[name].splitlines()]
        order += [kind for kind in dict.fromkeys(kinds) if kind not in (*SIZES, "string", *order)]
    return _RULE.join([fields[root], *(f"MSG: {name}\n{fields[name]}" for name in order[1:])]) + "\n"


@cache
def bundled_structure(type_name: str) -> Structure | None:
    """The tree of a bundled type, None when it is not bundled."""
    text = definition_text(type_name)
    return None if text is None else parse_msg(type_name, text)


def bundled_types() -> tuple[str, ...]:
    """Every bundled type as ``package/msg/Name``."""
    return tuple(name.replace("/", "/msg/") for name in _fields())


def field_names(type_name: str) -> tuple[str, ...]:
    """Leaf field paths of a bundled type; empty when it is not bundled."""
    structure = bundled_structure(type_name)
    return () if structure is None else tuple(leaf_paths(structure))
