"""Starting the server."""

import os
import socket
from collections.abc import Callable
from pathlib import Path

from pipeline.report.bundle import warm_bundle
from pipeline.web.app import build_app
from pipeline.web.errors import WorkbenchError
from pipeline.web.guard import LOOPBACK, make_token
from pipeline.web.limits import Limits

_LAST_PORT = 65535


def is_loopback(host: str) -> bool:
    """Whether an address can be reached from this machine only."""
    return host in LOOPBACK or host == "::1"


def serve(
    results: Path,
    *,
    host: str,
    port: int,
    tell: Callable[[str, str], None],
    limits: Limits,
    diagnosis: bool = True,
) -> None:
    """Serve the workbench until it is interrupted.

    Args:
        results: the results folder.
        host: address to listen on; anything but the loopback opens it to the network.
        port: 0 takes any that is free.
        tell: told the address and the token once it listens.
        limits: what logs and work on them may cost.
        diagnosis: whether a dropped log is diagnosed too.

    Raises:
        WorkbenchError: ``no_such_port``; ``port_taken``, nothing can listen there.
    """
    from pipeline.web.connections import WorkbenchServer, raise_open_files  # noqa: PLC0415 - heavy

    # Processes that are started from here take no code from the folder they are started in.
    os.environ["PYTHONSAFEPATH"] = "1"
    if host == "localhost":
        # On the other address of that name somebody else may listen, and would be sent the token.
        host = LOOPBACK[0]
    listener = _listen(host, port)
    hosts = LOOPBACK if is_loopback(host) else (*LOOPBACK, host.lower(), *_own_names(host))
    token = make_token()
    app = build_app(results, token=token, hosts=hosts, limits=limits, diagnosis=diagnosis)
    warm_bundle()
    shown = f"[{host}]" if ":" in host else host
    tell(f"http://{shown}:{listener.getsockname()[1]}/", token)
    WorkbenchServer(app, raise_open_files()).run(sockets=[listener])


def _listen(host: str, port: int) -> socket.socket:
    if not 0 <= port <= _LAST_PORT:
        hint = "Give another --port, or 0 for any that is free."
        raise WorkbenchError(
            "no_such_port", f"ports are 0 to {_LAST_PORT}", where=f"{host}:{port}", hint=hint
        )
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        # Whoever reads the address may ask at once; the answer comes when the server is ready.
        listener.listen()
    except OSError as error:
        listener.close()
        hint = "Give another --port, or 0 for any that is free."
        raise WorkbenchError(
            "port_taken", f"nothing can listen there: {error.strerror}", where=f"{host}:{port}", hint=hint
        ) from error
    return listener


def _own_names(host: str) -> tuple[str, ...]:
    """Names of this machine, where it listens on all addresses."""
    if host not in {"0.0.0.0", "::"}:  # noqa: S104 - compared, not bound
        return ()
    name = socket.gethostname().lower()
    try:
        addresses = {str(info[4][0]) for info in socket.getaddrinfo(name, None)}
    except OSError:
        addresses = set()
    return (name, f"{name}.local", *(f"[{each}]" if ":" in each else each for each in sorted(addresses)))
