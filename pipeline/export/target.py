"""What a target is: a name, where its parameters are documented, and the text it makes of a model."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pipeline.models.model_file import ModelFile

Current = Mapping[str, float]


@dataclass(frozen=True)
class Target:
    """Something that people run.

    Attributes:
        name: as the command line has it.
        about: what is written.
        source: where its parameters' names, units and meanings were read, with the version.
        write: makes the text of a model file and of parameters that the robot has now, by name.
        corrects: names of those it reads; none where all its numbers are absolute.
        read_current: reads them out of the text of the robot's file.
        has_errors: whether it writes held-out errors, which a log may be named for.
    """

    name: str
    about: str
    source: str
    write: Callable[[ModelFile, Current], str]
    corrects: tuple[str, ...] = ()
    read_current: Callable[[str], Current] | None = None
    has_errors: bool = False
