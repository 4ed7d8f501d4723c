"""What the results of a log depend on beside the log: a hash to tell when to look at it again.

It covers more than the keys of the stages do, so that it can be had without opening the log: when it differs,
the keys decide what has to be computed.
"""

import hashlib
from dataclasses import fields
from functools import cache
from pathlib import Path

import msgspec

from pipeline.analysis import Options, diagnosis
from pipeline.analysis.keys import VERSIONS, hash_json
from pipeline.vehicles import list_configuration_files, list_presets

_WITHOUT_INFLUENCE = ("out", "run", "config", "fleet", "report", "figures", "force")
"""Options that the tables do not depend on, or whose content is hashed by itself."""


class BasisHasher:
    """Hashes the basis of many logs, reading each configuration file once.

    Args:
        options: what the user asked for.
    """

    def __init__(self, options: Options) -> None:
        self._options = options
        asked = {each.name: getattr(options, each.name) for each in fields(options)}
        asked = {name: value for name, value in asked.items() if name not in _WITHOUT_INFLUENCE}
        self._shared = hash_json([msgspec.to_builtins(asked, enc_hook=str), _describe_program()])
        self._contents: dict[Path, str] = {}

    def hash_basis(self, log: Path) -> str:
        """Hash for one log."""
        files = list_configuration_files(log, given=self._options.config, fleet=self._options.fleet)
        return hash_json([self._shared, [[str(file), self._hash_content(file)] for file in files]])

    def _hash_content(self, file: Path) -> str:
        known = self._contents.get(file)
        if known is None:
            try:
                known = hashlib.sha256(file.read_bytes()).hexdigest()
            except OSError as error:
                known = f"unreadable: {error.errno}"
            self._contents[file] = known
        return known


@cache
def _describe_program() -> object:
    # The contracts bring a table library along, which a batch needs anyway.
    from schemas import list_contracts  # noqa: PLC0415

    return [
        {**VERSIONS, diagnosis.STAGE: diagnosis.VERSION},
        {contract.name: contract.version for contract in list_contracts()},
        [msgspec.to_builtins(vehicle) for vehicle in list_presets()],
    ]
