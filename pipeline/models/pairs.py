"""Facts about pairs of effects, from one table: what contains, resembles, accompanies or equals what."""

import tomllib
from functools import cache
from importlib import resources
from typing import Any


@cache
def list_pairs() -> dict[str, dict[str, Any]]:
    """For every effect of `pairs.toml` the attributes of `Effect` that name other effects."""
    table = tomllib.loads(resources.files("pipeline.models").joinpath("pairs.toml").read_text())
    relations: dict[str, dict[str, Any]] = {}
    for pair in table.pop("equivalent"):
        for one, other in (pair["effects"], pair["effects"][::-1]):
            facts = relations.setdefault(one, {"equivalent_to": ()})
            facts["equivalent_to"] += (other,)
            facts["equivalent_when"] = "; ".join(filter(None, (facts.get("equivalent_when"), pair["when"])))
    for relation, others in table.items():
        for name, related in others.items():
            relations.setdefault(name, {})[relation] = tuple(related)
    return relations
