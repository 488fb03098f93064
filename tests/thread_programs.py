"""Programs with threads, each for a process of its own; they print what they found.

python thread_programs.py first-use {load,parse,alone} TRIAL
python thread_programs.py solve {together,apart} TRIAL TRIAL
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from threading import Barrier
from typing import Any

import numpy as np

import factorgraph_dvl

Work = Callable[[], Any]

# Further threads that parse. Chosen: with them 23 of 60 runs crash where types have no lock, with
# none 7 of 60.
_MORE = 3


def first_use(in_main: str, trial: Path) -> str:
    """Load a trial, parse its settings and import the solvers, all for the first time."""
    # Otherwise the parsers would only wait for the import of what they parse with.
    files_of = import_module("factorgraph_dvl.files.trial_folder").files_of

    def load() -> Any:
        return digest(factorgraph_dvl.load_trial(trial))

    def parse() -> Any:
        return sorted(path.name for path in files_of(trial))

    def import_solvers() -> Any:
        return import_module("factorgraph_dvl.solvers.information_along_trial").__name__

    first, other = (load, parse) if in_main != "parse" else (parse, load)
    works = [first, other, *_MORE * [parse], import_solvers]
    found = [work() for work in works] if in_main == "alone" else at_once(*works)
    return "\n".join(sorted(map(str, found)))


def solve(how: str, *trials: Path) -> str:
    """Load and solve trials, in a thread each or one after another."""
    works = [lambda path=path: digest(solved(path)) for path in trials]
    found = at_once(*works) if how == "together" else [work() for work in works]
    return "\n".join(found)


def solved(path: Path) -> Any:
    return factorgraph_dvl.solve(factorgraph_dvl.load_trial(path))


def at_once(first: Work, *others: Work) -> list[Any]:
    """Return what each finds; the first runs in this thread, the others in one each."""
    together = Barrier(1 + len(others))

    def begin(work: Work) -> Any:
        together.wait()
        return work()

    # As often as can be, one thread goes on where another has stopped.
    sys.setswitchinterval(1e-6)
    with ThreadPoolExecutor(len(others)) as pool:
        waiting = [pool.submit(begin, work) for work in others]
        return [begin(first), *(future.result() for future in waiting)]


def digest(value: Any) -> str:
    """Return a hash of all numbers and texts in a value."""
    found = hashlib.sha256()
    for part in parts(value):
        found.update(part)
    return found.hexdigest()


def parts(value: Any) -> Iterator[bytes]:
    if isinstance(value, np.ndarray):
        yield f"{value.dtype}{value.shape}".encode()
        yield value.tobytes()
    elif is_dataclass(value):
        for field in fields(value):
            yield field.name.encode()
            yield from parts(getattr(value, field.name))
    elif isinstance(value, Mapping):
        yield from parts(list(value.items()))
    elif isinstance(value, tuple | list):
        yield str(len(value)).encode()
        for item in value:
            yield from parts(item)
    else:
        text = repr(value)
        assert " at 0x" not in text, text
        yield text.encode()


if __name__ == "__main__":
    program = {"first-use": first_use, "solve": solve}[sys.argv[1]]
    print(program(sys.argv[2], *map(Path, sys.argv[3:])))
