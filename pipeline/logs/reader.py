"""Reading the wanted topics of a recording as columns, and joining the channels of a topic."""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pipeline.core import Ints, group_by, map_in_order, name_first, usable_threads
from pipeline.logs.bags import read_database
from pipeline.logs.catalog import Coverage, DataSection, limit_inflated
from pipeline.logs.cdr import MAX_TEXT
from pipeline.logs.channel import ChannelBuffer, Recipe, decoder_for
from pipeline.logs.chunks import ByteSpan, SpanKind
from pipeline.logs.columns import (
    STAMPS,
    Column,
    Key,
    Payloads,
    Ragged,
    RaggedStrings,
    Strings,
    complete_stamps,
    derive_columns,
    digest_messages,
    find_repeated,
    gather_payloads,
    join_times,
    share_times,
)
from pipeline.logs.decode import take_rows
from pipeline.logs.index import ChannelInfo, LogIndex, Part, open_log
from pipeline.logs.part import count_fetched, hash_sources, open_source
from pipeline.logs.records import OTHER_VERSION, SQLITE_BAG, ByteSource, LogError, Loss
from pipeline.logs.schema import short_name
from pipeline.logs.spans import Loaded, load_spans


@dataclass(frozen=True, slots=True)
class Wanted:
    """A topic to read.

    Attributes:
        topic: name of the topic.
        fields: paths of fields such as ``twist.twist.linear.x``, ``velocity``, ``velocity[0]`` or
            ``transforms[].child_frame_id``; a path of a structure selects all its fields. None selects all.
        alike: by other types of the topic (``package/Name``), their own paths of the fields; channels of
            these types are read as if they were of the first.
        layouts: paths of the fields in the layouts that the type has had, the present one first: the first
            that the definition in the log has is read as if it were the present one. None of a type that is
            not known.
        optional: those of the fields that a topic may lack, such as JSON messages without them: there is no
            column of them then.
    """

    topic: str
    fields: tuple[str, ...] | None = None
    alike: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    optional: frozenset[str] = frozenset()
    layouts: tuple[Mapping[str, str], ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class TopicColumns:
    """The messages of one channel as columns, in the order of their log times.

    Attributes:
        topic: name of the topic.
        channel_id: number of the channel in the recording.
        type_name: ``package/msg/Name``.
        log_time: times of recording [ns], int64, shape (n,).
        publish_time: times of publication [ns], int64, shape (n,).
        header_time: stamps of the headers [ns], int64, shape (n,); None if the type has no header.
        fields: columns by wanted field.
        notes: remarks that are not losses.
    """

    topic: str
    channel_id: int
    type_name: str
    log_time: Ints
    publish_time: Ints
    header_time: Ints | None
    fields: Mapping[str, Column]
    notes: tuple[str, ...]

    def __len__(self) -> int:
        return self.log_time.size


@dataclass(frozen=True, slots=True, eq=False)
class LogData:
    """Data read from a recording.

    Attributes:
        index: index of the recording.
        topics: columns of every channel of the wanted topics that could be decoded.
        unfit: times of the channels that lack the wanted fields, which others of their topics have.
        losses: all known losses.
        notes: remarks that are not losses.
        sha256: SHA-256 of the recording's bytes (hex); for an object, of its version and size.
        fetched_bytes: number of bytes fetched from an object store.
        unchecked: description of the data that no checksum covers; empty if all data read is covered.
        repeated: number of omitted duplicates of messages, by topic.
        readable: number of messages that could be decoded, duplicates included, by channel number.
    """

    index: LogIndex
    topics: tuple[TopicColumns, ...]
    losses: tuple[Loss, ...]
    notes: tuple[str, ...]
    sha256: str
    fetched_bytes: int = 0
    unchecked: str = ""
    repeated: Mapping[str, int] = field(default_factory=dict)
    readable: Mapping[int, int] = field(default_factory=dict)
    unfit: tuple[TopicColumns, ...] = ()

    def of(self, topic: str) -> list[TopicColumns]:
        """Columns of every channel of a topic."""
        return [columns for columns in self.topics if columns.topic == topic]


def _count_missing(counted: Iterable[tuple[ChannelInfo, int]], losses: Sequence[Loss]) -> list[Loss]:
    """Losses of messages that the summary counts but that were not found, if no other loss explains them.

    Args:
        counted: channels with the number of their messages that were found.
        losses: known losses.
    """
    if losses:
        return []
    return [
        Loss(
            "missing_messages",
            f"the summary counts {info.message_count} messages of {info.topic}, {counted_here} were found",
        )
        for info, counted_here in counted
        if counted_here < info.message_count
    ]


def read_topics(
    path: str | os.PathLike[str] | LogIndex,
    wanted: Iterable[Wanted],
    *,
    threads: int | None = None,
    sha256: str | None = None,
    skip_unfit: bool = False,
) -> LogData:
    """Read topics of a recording.

    Args:
        path: the recording, or its index from ``open_log``.
        wanted: topics and fields.
        threads: number of chunks inflated at once; by default as many as this process may use.
        sha256: hash of the recording if known; otherwise it is computed in parallel with reading.
        skip_unfit: whether a topic without the wanted fields is left out instead of an error.

    Raises:
        LogError: as ``open_log``; ``topic_not_found``, ``field_not_found``. A topic in an unsupported
            encoding is a loss, not an error: the others are read.
    """
    index = path if isinstance(path, LogIndex) else open_log(path)
    workers = threads or usable_threads()
    losses: dict[Loss, None] = dict.fromkeys(index.losses)
    notes = list(index.notes)
    jobs = _choose_channels(index, wanted, losses, notes, skip_unfit=skip_unfit)
    coverage, walked = Coverage(), 0
    with ExitStack() as stack:
        sources = [stack.enter_context(open_source(part.path, part.version)) for part in index.parts]
        beside = stack.enter_context(ThreadPoolExecutor(1, thread_name_prefix="hash"))
        sections = [
            DataSection(source, part.catalog, beside)
            for part, source in zip(index.parts, sources, strict=True)
        ]
        digest = None if sha256 is not None else beside.submit(hash_sources, sources)
        for part, source, section in zip(index.parts, sources, sections, strict=True):
            unchecked, is_damaged = 0, bool(index.losses)
            for gathered in _read_part(source, part, set(jobs), workers):
                unchecked += gathered.unchecked
                coverage.spans += gathered.spans
                walked += gathered.index_damaged
                losses.update(dict.fromkeys(gathered.losses))
                is_damaged |= bool(gathered.losses)
                for number, payloads in gathered.payloads.items():
                    jobs[number].buffer.add(payloads)
            mismatch = section.judge(unchecked, is_damaged=is_damaged)
            if mismatch is not None:
                losses[mismatch] = None
            coverage.unchecked += unchecked if unchecked and not section.holds() else 0
            coverage.topics += _find_uncovered(part, jobs, section)
        repeated = _find_repeated(list(zip(index.parts, sources, strict=True)), jobs, workers)
        digest_read = digest.result() if digest is not None else (sha256 or "")
        fetched = index.fetched_bytes + count_fetched(sources)
    if walked:
        notes.append(f"the message indexes of {walked} chunks are damaged; their records were read instead")
    counted = [(job.info, job.buffer.count) for job in jobs.values()]
    losses.update(dict.fromkeys(_count_missing(counted, tuple(losses))))
    topics: list[TopicColumns] = []
    unfit: list[TopicColumns] = []
    finish = partial(_finish, repeated=repeated, skip_unfit=skip_unfit)
    for columns, lost in map_in_order(finish, jobs.values(), workers):
        losses.update(dict.fromkeys(lost))
        (unfit if jobs[columns.channel_id].is_unfit else topics).append(columns)
    twice = {jobs[number].info.topic: 0 for number in repeated}
    for number, rows in repeated.items():
        twice[jobs[number].info.topic] += rows.size
    none = np.empty(0, dtype=np.int64)
    readable = {one.channel_id: len(one) + repeated.get(one.channel_id, none).size for one in topics}
    return LogData(
        index,
        tuple(topics),
        tuple(losses),
        tuple(notes),
        digest_read,
        fetched,
        coverage.format_coverage(),
        twice,
        readable,
        tuple(unfit),
    )


@dataclass(slots=True, eq=False)
class _Gathered:
    """Wanted payloads of one span, by the recording's channel number, with its losses and coverage."""

    payloads: dict[int, Payloads]
    losses: list[Loss]
    spans: int
    unchecked: int
    index_damaged: bool


@dataclass(slots=True, eq=False)
class _Job:
    info: ChannelInfo
    recipe: Recipe
    buffer: ChannelBuffer
    fields: tuple[str, ...] | None
    spelled: Mapping[str, str]
    type_name: str
    is_unfit: bool = False


def _choose_channels(
    index: LogIndex,
    wanted: Iterable[Wanted],
    losses: dict[Loss, None],
    notes: list[str],
    *,
    skip_unfit: bool,
) -> dict[int, _Job]:
    """Decoders of the wanted channels by the recording's channel number."""
    jobs: dict[int, _Job] = {}
    schemas = _list_schemas(index)
    types = index.types
    by_topic = group_by((info.topic, info) for info in index.channels)
    for topic, want in _merge_wanted(wanted).items():
        infos = by_topic.get(topic)
        if not infos:
            raise _no_topic(index, topic)
        errors: list[LogError] = []
        plain = {info.id: short_name(info.type_name.replace(".", "/")) for info in infos}
        for info in infos:
            own = want.alike.get(plain[info.id], {})
            name = types[topic] if own else info.type_name
            try:
                paths, recipe = _fit_layout(info, schemas[info.id], want, own, str(index.path))
                fields = None if want.fields is None else tuple(paths.values())
                spelled = {path: wanted for wanted, path in paths.items()}
                jobs[info.id] = _Job(info, recipe, ChannelBuffer(recipe.decoder), fields, spelled, name)
            except LogError as error:
                errors.append(error)
                if error.code == "unsupported_encoding" and info.message_count:
                    text = f"{info.message_count} messages of {topic}: {error.what}"
                    losses[Loss(error.code, text, start_ns=index.start_ns, end_ns=index.end_ns)] = None
        unfit = [error for error in errors if error.code != "unsupported_encoding"]
        if len(errors) < len(infos):
            for info in (one for one in infos if one.id not in jobs and one.message_count):
                with suppress(LogError):
                    recipe = decoder_for(info, schemas[info.id], (), where=str(index.path))
                    buffer = ChannelBuffer(recipe.decoder)
                    jobs[info.id] = _Job(info, recipe, buffer, (), {}, info.type_name, is_unfit=True)
        if unfit and len(errors) == len(infos) and not skip_unfit:
            raise unfit[0]
        notes += [f"{topic} has several channels; {error.what} in one of them" for error in unfit]
    return jobs


def _fit_layout(
    info: ChannelInfo, schema: bytes, want: Wanted, own: Mapping[str, str], where: str
) -> tuple[Mapping[str, str], Recipe]:
    """The path of each wanted field in the first layout that a channel's definition has, and its decoder.

    Args:
        info: the channel.
        schema: data of its schema.
        want: the request.
        own: paths of a type that is alike; empty for the topic's own type.
        where: log named in errors.

    Raises:
        LogError: as `decoder_for`.
    """
    if want.fields is None:
        return {}, decoder_for(info, schema, None, where=where)
    known: Mapping[str, str] = want.layouts[0] if want.layouts else {}
    missing: LogError | None = None
    for layout in [own] if own else want.layouts or [known]:
        paths = dict(own) or {
            path: layout.get(path, path) for path in want.fields if path in layout or path not in known
        }
        optional = {paths.get(path, path) for path in want.optional}
        try:
            return paths, decoder_for(info, schema, tuple(paths.values()), optional, where=where)
        except LogError as error:
            if error.code != "field_not_found":
                raise
            missing = missing or error
    if missing is None:
        raise AssertionError
    if not known:
        raise missing
    with suppress(LogError):
        decoder_for(info, schema, tuple(known), want.optional, where=where)
        # What is missing is a field that the user named.
        known = {}
    if not known:
        raise missing
    package = info.type_name.partition("/")[0]
    what = f"the log defines {info.type_name} as another version of {package} than is known here does"
    hint = f"{missing.hint}. Name the fields by their paths, for example [pose] x, y and yaw in run.toml"
    raise LogError(missing.code, what, where=missing.where, hint=hint)


def _merge_wanted(wanted: Iterable[Wanted]) -> dict[str, Wanted]:
    """Requests by topic; a topic that is wanted twice has the fields of both requests."""
    merged: dict[str, Wanted] = {}
    for want in wanted:
        before = merged.get(want.topic)
        if before is None:
            merged[want.topic] = want
        elif before.fields is None or want.fields is None:
            merged[want.topic] = Wanted(want.topic)
        else:
            fields = tuple(dict.fromkeys((*before.fields, *want.fields)))
            needed = {name for one in (before, want) for name in one.fields or () if name not in one.optional}
            alike = {
                name: {**paths, **want.alike[name]}
                for name, paths in before.alike.items()
                if name in want.alike
            }
            layouts = tuple(
                {**one, **other} for one, other in zip(before.layouts, want.layouts, strict=False)
            )
            merged[want.topic] = Wanted(want.topic, fields, alike, frozenset(fields) - needed, layouts)
    return merged


_MOST_LISTED: Final = 20_000
"""Maximum number of messages of a JSON or protobuf topic that are read for the names of its fields."""


def list_fields(index: LogIndex) -> dict[str, tuple[str, ...]]:
    """Leaf fields of every topic with messages; topics that cannot be decoded are left out.

    Fields of JSON and protobuf are known from the messages, and unknown where these are very many.
    """
    schemas = _list_schemas(index)
    fields: dict[str, tuple[str, ...]] = {}
    for info in index.channels:
        if not info.message_count:
            continue
        with suppress(LogError):
            leaves = decoder_for(info, schemas[info.id], None, where=str(index.path)).leaves
            if not leaves and info.message_count <= _MOST_LISTED:
                read = read_topics(index, [Wanted(info.topic)], sha256="unused").of(info.topic)
                leaves = tuple(name for columns in read for name in columns.fields)
            fields[info.topic] = (*fields.get(info.topic, ()), *leaves)
    return fields


def _no_topic(index: LogIndex, topic: str) -> LogError:
    hint = f"It holds: {name_first(index.topics()) or 'no topics'}"
    return LogError("topic_not_found", f"there is no topic {topic}", where=str(index.path), hint=hint)


def _find_uncovered(part: Part, jobs: Mapping[int, _Job], section: DataSection) -> list[str]:
    """Topics whose schema or channel record is covered by no checksum."""
    bare = [
        jobs[merged].info.topic
        for number, merged in part.numbers.items()
        if merged in jobs and part.catalog.is_bare(number)
    ]
    return [] if bare and section.holds() else bare


def _list_schemas(index: LogIndex) -> dict[int, bytes]:
    """Schema data of every channel, by its number in the recording."""
    schemas: dict[int, bytes] = {}
    for part in index.parts:
        for own, number in part.numbers.items():
            schema = part.catalog.schemas.get(part.catalog.channels[own].schema_id)
            schemas.setdefault(number, schema.data if schema else b"")
    return schemas


def _read_part(source: ByteSource, part: Part, wanted: set[int], threads: int) -> Iterator[_Gathered]:
    own = {number for number, merged in part.numbers.items() if merged in wanted}
    if part.catalog.container == SQLITE_BAG:
        most = limit_inflated(part.size_bytes, part.catalog.most_inflated)
        held = read_database(part.path, part.catalog, own, most) if own else ()
        return (_gather_rows(part, payloads, losses) for payloads, losses in held)

    def gather(span: ByteSpan, loaded: Loaded) -> _Gathered:
        payloads = gather_payloads(loaded.chunk, loaded.messages, own)
        merged = {part.numbers[number]: each for number, each in payloads.items()}
        # A cut chunk at the end of a file is already reported as a loss.
        spans = int(bool(merged) and span.kind is not SpanKind.CUT_CHUNK)
        return _Gathered(merged, loaded.losses, spans, spans * loaded.unchecked, loaded.index_damaged)

    return load_spans(source, _spans_with(part, own), gather, threads=threads)


def _gather_rows(part: Part, payloads: Mapping[int, Payloads], losses: list[Loss]) -> _Gathered:
    merged = {part.numbers[number]: each for number, each in payloads.items()}
    # Databases store no checksums of their messages.
    stretch = int(bool(merged))
    return _Gathered(merged, losses, stretch, stretch, index_damaged=False)


def _spans_with(part: Part, own: set[int]) -> list[ByteSpan]:
    return [span for span in part.catalog.spans if span.channels is None or span.channels & own]


def _find_repeated(
    parts: Sequence[tuple[Part, ByteSource]], jobs: Mapping[int, _Job], threads: int
) -> dict[int, Ints]:
    """Indices of the messages that are byte-for-byte copies of earlier ones, by channel."""
    suspects = {number: share_times(*job.buffer.times()) for number, job in jobs.items()}
    suspects = {number: rows for number, rows in suspects.items() if rows.size}
    if not suspects:
        return {}
    times = {number: np.unique(jobs[number].buffer.times()[0][rows]) for number, rows in suspects.items()}
    keys: dict[int, list[Key]] = {number: [] for number in suspects}
    for part, source in parts:
        # Reading exactly the same channels again yields the same messages in the same order.
        own = {number for number, merged in part.numbers.items() if merged in jobs}
        asked = {number: times[part.numbers[number]] for number in own if part.numbers[number] in times}

        def digest(
            _span: ByteSpan, loaded: Loaded, asked: Mapping[int, Ints] = asked
        ) -> dict[int, list[Key]]:
            return digest_messages(loaded.chunk, loaded.messages, asked)

        for keys_of in load_spans(source, _spans_with(part, own), digest, threads=threads):
            for number, added in keys_of.items():
                keys[part.numbers[number]] += added
    repeated: dict[int, Ints] = {}
    for number, rows in suspects.items():
        log, publish = jobs[number].buffer.times()
        expected = set(zip(log[rows].tolist(), publish[rows].tolist(), strict=True))
        here = [key for key in keys[number] if key[:2] in expected]
        again = find_repeated(here) if len(here) == rows.size else []
        if again:
            repeated[number] = rows[again]
    return repeated


_OTHER_VERSION: Final = (
    "the log does not hold the definition of {kind}, and the messages are of another version of {package} "
    "than the definition that is known here: record to MCAP, which holds the definitions (`ros2 bag record "
    "-s mcap`), or convert the log to MCAP where that version of {package} is installed (`ros2 bag convert`)"
)


def _finish(job: _Job, repeated: Mapping[int, Ints], *, skip_unfit: bool) -> tuple[TopicColumns, list[Loss]]:
    repeated_rows = repeated.get(job.info.id, np.empty(0, dtype=np.int64))
    log_time, publish_time, rows = job.buffer.finish(repeated_rows)
    leaves: dict[str, Column] = {}
    try:
        leaves = job.recipe.decoder.columns(rows)
    except LogError:
        # Which fields there are is known of some encodings only from the messages.
        if not skip_unfit:
            raise
        job.is_unfit = True
    header_time = _header_time(leaves, log_time)
    columns_of = derive_columns(leaves, job.fields, job.recipe.leaves or tuple(leaves))
    fields = {job.spelled.get(path, path): column for path, column in columns_of.items()}
    losses = []
    for rejected in job.recipe.decoder.rejected:
        start, end = job.buffer.times_of(rejected.rows)
        kind, reason = rejected.kind, rejected.reason
        if job.recipe.is_bundled and rejected.rows.size == job.buffer.count:
            kind, reason = (
                OTHER_VERSION,
                _OTHER_VERSION.format(kind=job.info.type_name, package=job.info.type_name.partition("/")[0]),
            )
        text = f"{rejected.rows.size} messages of {job.info.topic}: {reason}"
        losses.append(Loss(kind, text, rejected.bytes, 0, start, end))
    for field_path, count in job.recipe.decoder.shortened.items():
        text = (
            f"{count} strings in {field_path} of {job.info.topic} are longer than {MAX_TEXT} bytes: cut there"
        )
        losses.append(Loss("long_string", text))
    columns = TopicColumns(
        job.info.topic,
        job.info.id,
        job.type_name,
        log_time,
        publish_time,
        header_time,
        fields,
        (*job.recipe.notes, *job.recipe.decoder.notes),
    )
    return columns, losses


def _header_time(leaves: Mapping[str, Column], log_time: Ints) -> Ints | None:
    for prefix in STAMPS:
        seconds, nanoseconds = leaves.get(f"{prefix}sec"), leaves.get(f"{prefix}nanosec")
        if not isinstance(seconds, np.ndarray) or not isinstance(nanoseconds, np.ndarray):
            continue
        stamp = complete_stamps(*join_times(seconds, nanoseconds), log_time)
        if stamp is not None:
            return stamp
    return None


def join_channels(channels: Sequence[TopicColumns]) -> TopicColumns | None:
    """Messages of several channels of one topic in log-time order.

    Args:
        channels: columns of one topic, at least one.

    Returns:
        The joined columns; None if the channels differ in type or fields and cannot form one series.
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
    plain = [column for column in columns if isinstance(column, np.ndarray)]
    if plain:
        return np.concatenate(plain)[order]
    texts = [column for column in columns if isinstance(column, Strings | RaggedStrings)]
    codes, names = _merge_codes([(column.codes, column.values) for column in texts])
    lists = [column for column in columns if isinstance(column, Ragged | RaggedStrings)]
    if not lists:
        return Strings(codes[order], names)
    values = codes if texts else np.concatenate([one.values for one in lists if isinstance(one, Ragged)])
    counts = np.concatenate([np.diff(column.offsets) for column in lists])
    values, offsets = take_rows(values, counts, order)
    return RaggedStrings(values.astype(np.int32), names, offsets) if texts else Ragged(values, offsets)


def _merge_codes(
    parts: Sequence[tuple[NDArray[np.int32], tuple[str, ...]]],
) -> tuple[NDArray[np.int32], tuple[str, ...]]:
    """Codes of several vocabularies converted to a common one, and its strings."""
    common: dict[str, int] = {}
    codes = []
    for own, values in parts:
        table = np.array([common.setdefault(text, len(common)) for text in values] + [-1], dtype=np.int32)
        codes.append(table[own])
    return np.concatenate([np.empty(0, dtype=np.int32), *codes]), tuple(common)
