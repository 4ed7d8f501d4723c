"""Poses out of chains of transforms, and poses of other frames moved to base_link."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.logs import TopicColumns
from pipeline.stages.extract.reading import PoseArrays
from pipeline.stages.finding import Finding
from pipeline.vehicles import PoseSource


@dataclass(frozen=True)
class ChainedPoses:
    """Poses of a chain at the child's stamps [ns]."""

    stamp: NDArray[np.int64]
    arrays: PoseArrays
    findings: tuple[Finding, ...]


def pose_from_transforms(topics: list[TopicColumns], source: PoseSource, where: str) -> ChainedPoses:
    raise KeyError(where)


def to_base_link(arrays: PoseArrays, topics: list[TopicColumns], topic: str) -> tuple[PoseArrays, list[Finding]]:
    return arrays, []
