"""One topic recorded on several channels, made one series again: a publisher that came back, a second one."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.core.arrays import Ints
from pipeline.logs.columns import Column, Ragged, RaggedStrings, Strings
from pipeline.logs.reader import TopicColumns


def join_channels(channels: Sequence[TopicColumns]) -> TopicColumns | None:
    """Messages of several channels of one topic in log-time order.

    Args:
        channels: columns of one topic, at least one.

    Returns:
        The joined columns; None where the channels differ in type or fields and cannot be one series.
    """
    first = channels[0]
    if len(channels) == 1:
        return first
    alike = all(
        one.type_name == first.type_name
        and one.fields.keys() == first.fields.keys()
        and (one.header_time is None) == (first.header_time is None)
        and all(type(one.fields[name]) is type(first.fields[name]) for name in first.fields)
        for one in channels
    )
    if not alike:
        return None
    order = np.argsort(np.concatenate([one.log_time for one in channels]), kind="stable")
    header = None
    if first.header_time is not None:
        header = np.concatenate([one.header_time for one in channels if one.header_time is not None])[order]
    return replace(
        first,
        log_time=np.concatenate([one.log_time for one in channels])[order],
        publish_time=np.concatenate([one.publish_time for one in channels])[order],
        header_time=header,
        fields={name: _join([one.fields[name] for one in channels], order) for name in first.fields},
        notes=tuple(dict.fromkeys(note for one in channels for note in one.notes)),
    )


def _join(columns: Sequence[Column], order: Ints) -> Column:
    ragged = [column for column in columns if isinstance(column, Ragged)]
    if ragged:
        rows, offsets = _reorder_rows([column.offsets for column in ragged], order)
        return Ragged(np.concatenate([column.values for column in ragged])[rows], offsets)
    lists = [column for column in columns if isinstance(column, RaggedStrings)]
    if lists:
        codes, values = _merge_codes([(column.codes, column.values) for column in lists])
        rows, offsets = _reorder_rows([column.offsets for column in lists], order)
        return RaggedStrings(codes[rows], values, offsets)
    texts = [column for column in columns if isinstance(column, Strings)]
    if texts:
        codes, values = _merge_codes([(column.codes, column.values) for column in texts])
        return Strings(codes[order], values)
    return np.concatenate([column for column in columns if isinstance(column, np.ndarray)])[order]


def _reorder_rows(parts: Sequence[Ints], order: Ints) -> tuple[Ints, Ints]:
    """Where each value of reordered rows comes from, and the new offsets."""
    counts = np.concatenate([np.diff(offsets) for offsets in parts])
    starts = np.cumsum(counts) - counts
    offsets = np.concatenate(([0], np.cumsum(counts[order])))
    inside = np.arange(offsets[-1]) - np.repeat(offsets[:-1], counts[order])
    return np.repeat(starts[order], counts[order]) + inside, offsets


def _merge_codes(
    parts: Sequence[tuple[NDArray[np.int32], tuple[str, ...]]],
) -> tuple[NDArray[np.int32], tuple[str, ...]]:
    """Codes of several vocabularies in a common one."""
    common: dict[str, int] = {}
    codes = []
    for own, values in parts:
        table = np.array([common.setdefault(text, len(common)) for text in values] + [-1], dtype=np.int32)
        codes.append(table[own])
    return np.concatenate(codes), tuple(common)
