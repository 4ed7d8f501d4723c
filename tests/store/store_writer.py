"""A writer in a process of its own, for tests that kill it.

store_writer.py die ROOT RUN KEY SEED STEP COUNT    write a generation, die at the COUNT-th STEP
store_writer.py loop ROOT RUN SEED ROUNDS           write one after another, tell each, prune in between
store_writer.py hold ROOT RUN                       open a generation and sleep
store_writer.py hold_with_child ROOT RUN            the same, with a forked child that sleeps as long
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

from store_samples import write_generation

from pipeline.store import Store


def die(*arguments: str) -> None:
    root, run, key, seed, step, count = arguments
    left = int(count)

    def watch(name: str) -> None:
        nonlocal left
        left -= name == step
        if left == 0 and name == step:
            os.kill(os.getpid(), signal.SIGKILL)

    write_generation(Store(Path(root), watch=watch), run, key, int(seed))


def loop(root: str, run: str, seed: str, rounds: str) -> None:
    store = Store(Path(root))
    for number in range(int(seed), int(seed) + int(rounds)):
        write_generation(store, run, f"key{number % 3}", number)
        _say(str(number))
        if number % 4 == 0:
            store.prune(1)


def hold(root: str, run: str) -> None:
    with Store(Path(root)).open_generation(run, "held"):
        _say("ready")
        time.sleep(60)


def hold_with_child(root: str, run: str) -> None:
    with Store(Path(root)).open_generation(run, "held"):
        child = os.fork()
        if child:
            _say(str(child))
        time.sleep(60)


def _say(word: str) -> None:
    sys.stdout.write(f"{word}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    {"die": die, "loop": loop, "hold": hold, "hold_with_child": hold_with_child}[sys.argv[1]](*sys.argv[2:])
