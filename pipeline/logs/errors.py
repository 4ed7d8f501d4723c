"""What can go wrong with a log, and what can be lost from one that is still read."""

from dataclasses import dataclass

from pipeline.core.errors import SlipError


class LogError(SlipError):
    """A log, topic or field that cannot be served.

    Codes: ``log_not_found``, ``log_empty``, ``not_mcap``, ``not_a_recording``, ``log_unreadable``,
    ``topic_not_found``, ``field_not_found``, ``frame_not_found``, ``unknown_type``, ``bad_column``,
    ``unsupported_encoding``, ``no_object_store``.
    """


def unsupported(what: str, where: str, hint: str = "Leave the topic out") -> LogError:
    """The error for messages that cannot be decoded."""
    return LogError("unsupported_encoding", what, where=where, hint=hint)


@dataclass(frozen=True, slots=True)
class Loss:
    """Something that stood in the log and did not come out of it whole.

    Attributes:
        kind: stable identifier, for example ``truncated``, ``chunk_crc``, ``damaged_record``,
            ``undecodable``, ``unsupported_encoding``, ``unchecked``.
        text: one clear line.
        bytes: bytes of the file concerned.
        chunks: chunks concerned.
        start_ns: first log time concerned, None when unknown.
        end_ns: last log time concerned, None when unknown.
    """

    kind: str
    text: str
    bytes: int = 0
    chunks: int = 0
    start_ns: int | None = None
    end_ns: int | None = None
