"""A log that is still being written: a live server as a growing recording, and what is valid at its end.

The client connects to this machine only. A separate process receives one message at a time; messages that it
cannot process in time queue at the server.

Repeated tests of growing evidence exceed any threshold in the end by chance. An effect therefore passes a
stricter test here than in a finished log, and passes it in two successive looks.
"""

import ipaddress
import math
import os
import re
import subprocess
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final, cast
from urllib.parse import urlsplit

import msgspec
import numpy as np

from pipeline.core import pick_finite, python_command
from pipeline.estimation.decision import LEAST_T
from pipeline.estimation.driving_need import find_goal
from pipeline.live import LiveError
from pipeline.live.receiver import ReceiverOrder, ReceiverState
from pipeline.logs.index import LISTING, GrowingLog, list_files
from pipeline.logs.live_recording import lock_folder
from pipeline.models import list_effects
from pipeline.results import (
    ABOVE_FLOOR,
    INTERVAL_SHARE,
    Named,
    RunDiagnosis,
    Value,
    find_refusal,
    measure_excess,
)
from pipeline.words import (
    describe_alarm,
    describe_clause,
    describe_need,
    describe_separation,
    format_step,
    suggest_drive,
)

_SCHEME: Final = re.compile(r"(wss?):/+", re.IGNORECASE)
_DEFAULT_PORT: Final = 8765
_START_S: Final = 60.0
_STOP_S: Final = 30.0
"""Time to write the last chunk and the listing of the files [s], on a busy disk."""
_FREE_S: Final = 3.0
"""Time for the receiver of a killed watch to notice it and to end its file [s]."""
_SAME_DRIVE_S: Final = 600.0
"""Largest age of an unfinished recording to continue it [s]: a killed program is restarted within minutes."""


@dataclass(frozen=True)
class LiveAddress:
    """Address of a server on this machine.

    Attributes:
        host: numeric address.
        port: port of the server.
        path: path of the URL.
    """

    host: str
    port: int
    path: str

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"ws://{host}:{self.port}{self.path}"


def parse_address(text: str) -> LiveAddress | None:
    """Parse an address such as ``ws://127.0.0.1:8765``; None if the text is a path.

    Args:
        text: text of the user; a slash that `Path` has removed may be missing.

    Raises:
        LiveError: ``bad_address``; ``not_this_machine``.
    """
    match = _SCHEME.match(text)
    if match is None:
        return None
    text = f"{match[1].lower()}://{text[match.end() :]}"
    hint = "Give one such as ws://127.0.0.1:8765"
    try:
        parts = urlsplit(text)
        name, port = parts.hostname or "", parts.port or _DEFAULT_PORT
    except ValueError as error:
        raise LiveError(
            "bad_address", f"the address cannot be read ({error})", where=text, hint=hint
        ) from error
    if parts.scheme == "wss" or parts.username or parts.query or parts.fragment or not name:
        what = "only a plain address can be watched: ws://, a host and a port"
        raise LiveError("bad_address", what, where=text, hint=hint)
    # Another program may listen on the other address of that name.
    host = "127.0.0.1" if name == "localhost" else name
    try:
        is_here = ipaddress.ip_address(host).is_loopback
    except ValueError:
        is_here = False
    if not is_here:
        what = "only a server on this machine is watched: the connection has no password and no encryption"
        tunnel = f"ssh -L {port}:127.0.0.1:{port} {name}"
        hint = f"Fetch its port here with `{tunnel}`, then watch ws://127.0.0.1:{port}"
        raise LiveError("not_this_machine", what, where=text, hint=hint)
    return LiveAddress(host, port, parts.path or "/")


def name_folder(address: LiveAddress, parent: Path) -> Path:
    """Folder of a recording: a recent one of a killed program, or a new one named by date."""
    begin = f"live_{address.port}_"
    unfinished = [
        folder
        for folder in parent.glob(f"{begin}*")
        if folder.is_dir() and not (folder / LISTING).exists() and _measure_age(folder) < _SAME_DRIVE_S
    ]
    newest = max(unfinished, key=lambda folder: folder.name, default=None)
    if newest is not None and _is_free(newest):
        return newest
    return parent / f"{begin}{time.strftime('%Y_%m_%d-%H_%M_%S')}"


def _is_free(folder: Path) -> bool:
    """Whether no process writes a recording; wait for the receiver of a killed watch to finish."""
    end = time.monotonic() + _FREE_S
    while True:
        with suppress(OSError):
            number = lock_folder(folder)
            if number is not None:
                os.close(number)
                return True
        if time.monotonic() > end:
            return False
        time.sleep(0.1)


def _measure_age(folder: Path) -> float:
    """Time since the last write to a file of a recording [s]; since 1970 if it has no files."""
    newest = max((file.stat().st_mtime for file in list_files(folder)), default=0.0)
    return time.time() - newest


def parse_topics(texts: Sequence[str]) -> dict[str, str]:
    """Types by topic from `--topic NAME` or `--topic NAME=TYPE`; the server reports the type if empty."""
    return {topic: kind for topic, _, kind in (text.partition("=") for text in texts)}


class ReceivingProcess:
    """A `LiveReceiver` in a separate process, with its last status.

    Args:
        address: address of the server.
        folder: folder of the recording.
        topics: topics from `parse_topics`.
    """

    def __init__(self, address: LiveAddress, folder: Path, topics: dict[str, str]) -> None:
        self.state = ReceiverState()
        self._process = subprocess.Popen(  # noqa: S603 - this program itself
            python_command("-m", "pipeline.live.receiver"),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            # The watch handles Ctrl-C and then ends the recording.
            start_new_session=True,
        )
        self._heard = threading.Event()
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()
        self._send(msgspec.json.encode(ReceiverOrder(str(address), str(folder), topics)) + b"\n")
        # The first status line reports whether a server answers; start and connection take time.
        self._heard.wait(_START_S)

    def _listen(self) -> None:
        for line in cast("BinaryIO", self._process.stdout):
            self.state = msgspec.json.decode(line, type=ReceiverState)
            self._heard.set()
        self._heard.set()

    def _send(self, line: bytes) -> None:
        stream = cast("BinaryIO", self._process.stdin)
        with suppress(BrokenPipeError):
            stream.write(line)
            stream.flush()

    def check(self) -> None:
        """Raise an error if the process has ended.

        Raises:
            LiveError: the error that has ended it.
        """
        self.raise_error()
        if self._process.poll() is not None:
            what = "the process that receives from the server has ended"
            hint = "Start the watch again: it goes on with the recording"
            raise LiveError("receiver_lost", what, hint=hint)

    def raise_error(self) -> None:
        """Raise the error that the process has reported, if any.

        Raises:
            LiveError: that error.
        """
        state = self.state
        if state.code:
            raise LiveError(state.code, state.what, where=state.where, hint=state.hint)

    def stop(self) -> None:
        """End the recording, and wait for it."""
        self._send(b"end\n")
        with suppress(BrokenPipeError):
            cast("BinaryIO", self._process.stdin).close()
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._listener.join()
        cast("BinaryIO", self._process.stdout).close()


class LiveLog(GrowingLog):
    """The recording of a receiver, followed while it is written.

    Args:
        path: folder of the recording.
        receiver: process that writes the recording.
        quiet_s: time after the start without any message that is an error [s].
    """

    def __init__(self, path: Path, receiver: ReceivingProcess, quiet_s: float) -> None:
        super().__init__(path)
        self._receiver, self._quiet_s = receiver, quiet_s
        self._begin = time.monotonic()

    def update(self) -> bool:
        """Index data added since the last call; return whether there were any.

        Raises:
            LiveError: the error that has ended the receiver; ``nothing_received``.
        """
        self._receiver.check()
        if list_files(self.path):
            return super().update()
        if time.monotonic() - self._begin > self._quiet_s:
            what = f"no message of motion came for {self._quiet_s:g} s ({self.note})"
            hint = "Start the robot's nodes, name topics with --topic, or wait longer with --for SECONDS"
            raise LiveError("nothing_received", what, hint=hint)
        return False

    @property
    def is_closed(self) -> bool:
        """Always false: a silent server may send again."""
        return False

    @property
    def note(self) -> str:
        """Status of the connection."""
        return self._receiver.state.note

    @property
    def cpu_s(self) -> float:
        """CPU time of the receiver [s]."""
        return self._receiver.state.cpu_s


@contextmanager
def receive_live(
    address: LiveAddress, folder: Path | None, topics: Sequence[str], quiet_s: float
) -> Iterator[LiveLog]:
    """Receive from a server while the block runs; the recording is complete afterwards.

    Args:
        address: address from `parse_address`.
        folder: folder of the recording; None for `name_folder` in the current folder.
        topics: topics for `parse_topics`; none for all topics of motion.
        quiet_s: see `LiveLog`.

    Raises:
        LiveError: error of the receiver: ``no_live_server``, ``recording_unwritable``, ...
    """
    path = folder or name_folder(address, Path())
    receiver = ReceivingProcess(address, path, parse_topics(topics))
    try:
        receiver.check()
        yield LiveLog(path, receiver, quiet_s)
    finally:
        receiver.stop()
    # Writing the end of the recording may fail too.
    receiver.raise_error()


RUNNING_T = 2.0 * LEAST_T
"""Threshold of t for naming in a running log, `LEAST_T` in a finished one: `make bench NAME=watch` counts
retracted names."""
_MOST_ASKS = 3
"""Maximum number of manoeuvres to ask for at once: as many as can be read while driving."""


@dataclass(frozen=True)
class Stated:
    """An effect that is reported of a log so far.

    Attributes:
        id: id of the effect.
        text: its influence on the motion, with its parameters.
        numbers: ``value``, ``low``, ``high`` and ``unit`` by parameter.
    """

    id: str
    text: str
    numbers: Mapping[str, Mapping[str, object]]

    def to_json(self) -> dict[str, object]:
        """The object of one effect."""
        return {
            "effect": self.id,
            "text": self.text,
            "parameters": {k: dict(v) for k, v in self.numbers.items()},
        }


def list_passing(diagnosis: RunDiagnosis) -> list[str]:
    """Ids of the effects that pass the test of a running log, regardless of the look before."""
    return [effect.id for effect in diagnosis.effects if _passes(effect)]


def list_stated(diagnosis: RunDiagnosis, before: Sequence[str]) -> list[Stated]:
    """The effects that may be reported after this look.

    Args:
        diagnosis: of the log so far.
        before: result of `list_passing` for the look before.
    """
    return [
        Stated(
            effect.id,
            describe_clause(effect, diagnosis),
            {
                name: {
                    **pick_finite(value, "value", "low", "high"),
                    "unit": value.unit,
                    "share": _measure_share(effect.id, name, value),
                }
                for name, value in effect.parameters.items()
            },
        )
        for effect in diagnosis.effects
        if _passes(effect) and effect.id in before
    ]


def summarize_knowledge(diagnosis: RunDiagnosis, before: Sequence[str]) -> dict[str, object]:
    """What is known after a look, what is not, and what to drive for it.

    Args:
        diagnosis: of the log so far.
        before: result of `list_passing` for the look before.

    Returns:
        ``stated``: effects with their parameters and relative uncertainties; ``waiting``: ids of effects that
        a second look must confirm; ``undecided``, ``unseen``: effects that are not separated or not
        observable; ``drive``: manoeuvres for them; ``enough``: whether more driving of this kind changes
        nothing, so that none is suggested; ``data``, ``error``, ``problem``: sentences; ``passing``: ids for
        the next look; ``alarms``: numbers beyond the range in which learners on board let them go.
    """
    passing = list_passing(diagnosis)
    stated = list_stated(diagnosis, before)
    names = {one.id for one in stated}
    unseen = [*diagnosis.unobservable_why]
    waiting = [one.id for one in diagnosis.effects if not one.corrected and one.id not in names]
    is_enough = _is_enough(diagnosis, stated, waiting)
    asks = [describe_separation(one) for one in diagnosis.undecided]
    asks += [part for name in unseen for part in suggest_drive(name).split("; ")]
    ladder = diagnosis.ladder
    problems = [one.text for one in diagnosis.findings if one.where == "diagnosis"]
    return {
        "stated": [one.to_json() for one in stated],
        "waiting": waiting,
        "undecided": [list(one.candidates) for one in diagnosis.undecided],
        "unseen": unseen,
        "drive": [] if is_enough else list(dict.fromkeys(asks))[:_MOST_ASKS],
        "enough": is_enough,
        "data": describe_need(diagnosis) or None,
        "error": format_step(ladder[-1]) if ladder else None,
        "problem": "" if ladder else next(iter(problems), find_refusal(diagnosis.findings)),
        "passing": passing,
        "alarms": list_alarms(one for one in diagnosis.effects if one.id in names),
    }


def list_alarms(effects: Iterable[Named]) -> list[dict[str, object]]:
    """Numbers of effects that are beyond the range in which learners on board let them go."""
    kinds, alarms = {kind.id: kind for kind in list_effects()}, list[dict[str, object]]()
    for effect in effects:
        for parameter in kinds[effect.id].parameters if effect.id in kinds else ():
            within, number = parameter.learned_within, effect.parameters.get(parameter.name)
            if within is not None and number is not None and not within.low <= number.value <= within.high:
                text = describe_alarm(effect.id, parameter, number.value)
                alarm = {"effect": effect.id, "parameter": parameter.name, "value": number.value}
                alarms.append({**alarm, "low": within.low, "high": within.high, "text": text})
    return alarms


def _is_enough(diagnosis: RunDiagnosis, stated: Sequence[Stated], waiting: Sequence[str]) -> bool:
    """Whether all effects are reported and known accurately, and the model is at the noise floor."""
    known = all(
        number["share"] is not None and cast("float", number["share"]) <= INTERVAL_SHARE
        for one in stated
        for number in one.numbers.values()
    )
    is_open = bool(waiting or diagnosis.undecided)
    return bool(stated) and known and not is_open and 0.0 < measure_excess(diagnosis) < ABOVE_FLOOR


def _passes(effect: Named) -> bool:
    """Whether a named effect has the evidence required in a running log; corrected clocks are excluded."""
    return not effect.corrected and measure_t(effect) >= RUNNING_T


def measure_t(effect: Named) -> float:
    """The t value of an effect at the end of the log so far; 0 if it was not searched for."""
    evidence = None if effect.growth is None else effect.growth.evidence
    return float(np.nan_to_num(evidence.t[-1])) if evidence is not None and evidence.t else 0.0


def _measure_share(effect: str, name: str, number: Value) -> float | None:
    """Half-width of an interval relative to the value, or to a typical one if that is larger."""
    if not math.isfinite(number.high - number.low):
        return None
    return INTERVAL_SHARE * 0.5 * (number.high - number.low) / find_goal(effect, name, number.value)
