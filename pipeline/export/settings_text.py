"""Sheets of parameters as YAML that ROS 2 reads, with a comment that says where each line came from."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq

if TYPE_CHECKING:
    from ruamel.yaml.nodes import ScalarNode
    from ruamel.yaml.representer import RoundTripRepresenter

    from pipeline.export.settings import Facts, Sheet


_INDENT = 2


def list_comments(facts: Facts, sheet: Sheet) -> list[str]:
    """What stands above the parameters: the head, and the effects that none of them stands for."""
    unmapped = facts.list_unmapped(sheet)
    lines = [*sheet.head, *(["No parameter there stands for:"] if unmapped else [])]
    return [make_plain(line) for line in [*lines, *(f"  {line}" for line in unmapped)]]


def make_plain(text: str) -> str:
    """A text that stands in one line, whatever names are in it."""
    return "".join(c if c.isprintable() else " " for c in text)


def write_yaml(facts: Facts, sheet: Sheet) -> str:
    """The text of a sheet as a ROS 2 parameter file."""
    tree = CommentedMap()
    for setting in sheet.settings:
        group = tree
        *above, name = setting.path.split(".")
        for node in above:
            group = group.setdefault(node, CommentedMap())
        group[name] = _make_value(setting.value)
        comment = "\n".join(make_plain(line) for line in setting.sources)
        group.yaml_set_comment_before_after_key(name, before=comment, indent=_INDENT * len(above))
    comments = "".join(f"# {line}\n" for line in list_comments(facts, sheet))
    if not tree:
        return comments
    yaml, text = YAML(), io.StringIO()
    yaml.width = 4096
    yaml.representer.add_representer(float, _represent_float)
    yaml.dump(tree, text)
    return comments + text.getvalue()


def _make_value(value: object) -> object:
    if not isinstance(value, tuple):
        return value
    row = CommentedSeq(value)
    row.fa.set_flow_style()
    return row


def _represent_float(representer: RoundTripRepresenter, value: float) -> ScalarNode:
    """A number with a point, which every reader of YAML takes for a double."""
    text = repr(value)
    if "." not in text:
        text = text.replace("e", ".0e")
    return representer.represent_scalar("tag:yaml.org,2002:float", text)
