"""Choosing how a channel is decoded from the encodings it declares."""

from dataclasses import dataclass
from typing import Final

from pipeline.logs.channel import StructuredDecoder
from pipeline.logs.definitions import bundled_structure
from pipeline.logs.errors import unsupported
from pipeline.logs.fields import select_leaves
from pipeline.logs.idl import parse_idl
from pipeline.logs.index import ChannelInfo
from pipeline.logs.objects import ObjectDecoder, decode_json, protobuf_decoder
from pipeline.logs.schema import SchemaError, Structure, contains_text, leaf_paths, parse_msg

_EMPTY: Final = "the schema is empty"
_STAMP: Final = ("header.stamp.sec", "header.stamp.nanosec")


@dataclass(frozen=True, slots=True, eq=False)
class Recipe:
    """How one channel is decoded.

    Attributes:
        decoder: does it.
        leaves: every leaf field of the type; empty where only the messages know.
        notes: what is worth knowing.
    """

    decoder: StructuredDecoder | ObjectDecoder
    leaves: tuple[str, ...]
    notes: tuple[str, ...] = ()


def decoder_for(info: ChannelInfo, schema: bytes, fields: tuple[str, ...] | None, *, where: str) -> Recipe:
    """Choose the decoder of a channel.

    Args:
        info: the channel.
        schema: data of its schema.
        fields: wanted field paths, None for all.
        where: the log, for messages.

    Raises:
        LogError: ``unsupported_encoding``, ``field_not_found``.
    """
    place = f"{where}, topic {info.topic}"
    if info.message_encoding == "json":
        return Recipe(ObjectDecoder(decode_json, fields, where=place), ())
    if info.message_encoding == "protobuf":
        decode = protobuf_decoder(schema, info.type_name, where=place)
        return Recipe(ObjectDecoder(decode, fields, where=place), ())
    structure, notes = _structure_of(info, schema, fields, place)
    leaves = tuple(leaf_paths(structure))
    chosen = select_leaves(leaves, fields, where=place)
    chosen |= {path for path in _STAMP if path in leaves}
    return Recipe(
        StructuredDecoder(
            structure,
            chosen,
            info.message_encoding,
            info.message_count,
            exact=bool(notes and structure.members),
        ),
        leaves,
        notes,
    )


def _structure_of(
    info: ChannelInfo, schema: bytes, fields: tuple[str, ...] | None, where: str
) -> tuple[Structure, tuple[str, ...]]:
    if info.message_encoding not in ("cdr", "ros1"):
        what = f"messages are encoded as {info.message_encoding!r}"
        raise unsupported(what, where, "Leave the topic out, or convert the log to cdr")
    structure, reason = _parse(info, schema)
    if structure is None:
        structure = bundled_structure(info.type_name) if info.message_encoding == "cdr" else None
        if structure is None and reason == _EMPTY and not fields:
            return Structure(info.type_name, ()), (f"{_EMPTY}; of its messages only the times were read",)
        if structure is None:
            what = f"type {info.type_name or '(none)'}: {reason}, and none is bundled"
            raise unsupported(what, where, "Record it again with its definition, or leave the topic out")
        return structure, (f"{reason}; the bundled one of {info.type_name} was used",)
    if contains_text(structure, "wstring"):
        raise unsupported("the type holds wide strings, whose layout differs between vendors", where)
    return structure, ()


def _parse(info: ChannelInfo, schema: bytes) -> tuple[Structure | None, str]:
    """The type as its schema defines it, or None and why not."""
    text = schema.decode("utf-8", "replace")
    if not text.strip():
        return None, _EMPTY
    try:
        if info.schema_encoding == "ros2idl":
            return parse_idl(info.type_name, text), ""
        if info.schema_encoding in ("ros2msg", "ros1msg"):
            return parse_msg(info.type_name, text, dialect=info.schema_encoding), ""
    except SchemaError as error:
        return None, f"the definition cannot be read ({error})"
    return None, f"the schema encoding {info.schema_encoding!r} is not known"
