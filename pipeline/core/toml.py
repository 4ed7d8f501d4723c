"""Reading TOML that anybody may have written: bounded size, depth and numbers, one kind of error.

The parser of the standard library ends with a recursion error on deep nesting, takes the square of the time
on long dotted keys, and knows whole numbers of any length.
"""

import math
import re
import tomllib
from collections.abc import Iterator, Mapping

from pipeline.core.errors import shorten

LONGEST = 2_000_000
DEEPEST = 16
_LARGEST = 2**63
_LINE = re.compile(r"\(at line (\d+)")
_PART = r"""(?:[\w-]++|"[^"\n]*"|'[^'\n]*')[ \t]*"""
_LONG_KEY = re.compile(rf"(?<![\w-])(?:{_PART}\.[ \t]*){{{DEEPEST}}}")


class TomlError(Exception):
    """A text that is no TOML, or none that anybody would write.

    Args:
        what: what is wrong, one line without a full stop.
        line: where, counted from one; None for the whole text.
        key: dotted name of the key it concerns; empty where there is none.
    """

    def __init__(self, what: str, line: int | None = None, key: str = "") -> None:
        super().__init__(what)
        self.what = shorten(what)
        self.line = line
        self.key = key


def parse_toml(text: str) -> dict[str, object]:
    """The tables of a TOML text.

    Raises:
        TomlError: it is not TOML, too long, nested too deeply, or holds a number beyond 64 bits.
    """
    if len(text) > LONGEST:
        raise TomlError(f"longer than {LONGEST} characters")
    long_key = _LONG_KEY.search(text)
    if long_key is not None:
        raise TomlError(f"a key of more than {DEEPEST} parts", text.count("\n", 0, long_key.start()) + 1)
    try:
        tree = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        found = _LINE.search(str(error))
        line = int(found[1]) if found else text.count("\n") + 1
        raise TomlError(f"not a valid TOML file: {' '.join(str(error).split())}", line) from None
    except ValueError:
        raise TomlError("a number of thousands of digits") from None
    except RecursionError:
        raise TomlError(f"nested more than {DEEPEST} deep") from None
    for key, value in walk(tree):
        if isinstance(value, int) and not -_LARGEST <= value < _LARGEST:
            raise TomlError(f"the number of {key} has more than 64 bits", key=key)
    return tree


def walk(tree: Mapping[str, object]) -> Iterator[tuple[str, object]]:
    """Every value that is no table and no list, with its dotted key.

    Raises:
        TomlError: nested too deeply.
    """
    stack: list[tuple[str, object, int]] = [("", tree, 0)]
    while stack:
        key, value, depth = stack.pop()
        if depth > DEEPEST:
            raise TomlError(f"{key[:80]} is nested more than {DEEPEST} deep", key=key)
        if isinstance(value, dict):
            stack += [(f"{key}.{name}" if key else name, inner, depth + 1) for name, inner in value.items()]
        elif isinstance(value, list):
            stack += [(key, inner, depth + 1) for inner in value]
        else:
            yield key, value


def require_finite(tree: Mapping[str, object]) -> None:
    """Refuse ``inf`` and ``nan`` where they can mean nothing.

    Raises:
        TomlError: with the key.
    """
    for key, value in walk(tree):
        if isinstance(value, float) and not math.isfinite(value):
            raise TomlError(f"{key} = {value} is no finite number", key=key)
