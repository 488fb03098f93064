"""Raw files that were packed with gzip."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.importing.decisions import Decisions
from factorgraph_dvl.settings.files import open_file

_ENDING = ".gz"
# With this many bits, zlib expects a header of gzip.
_GZIP = 16 + zlib.MAX_WBITS
# Bytes that are unpacked at a time. Chosen: some ms.
_PART = 1 << 20


@contextmanager
def unpacked(files: Sequence[Path], decisions: Decisions) -> Iterator[list[Path]]:
    """Yield files, those packed with gzip as temporary ones without that ending.

    Parameters
    ----------
    files : sequence of Path
        In any order.
    decisions : Decisions
        Takes which were unpacked, and how far a damaged one.

    Raises
    ------
    DataError
        If one cannot be unpacked.
    """
    with TemporaryDirectory() as folder:
        out = []
        for number, path in enumerate(files):
            if path.suffix.lower() == _ENDING:
                own = Path(folder) / str(number)
                own.mkdir()
                path = _unpack(path, own / path.stem, decisions)
            out.append(path)
        yield out


def _unpack(path: Path, to: Path, decisions: Decisions) -> Path:
    """Unpack a file up to its end, or up to damage."""
    expected = f"a file packed with gzip at {path}"
    size, damage = 0, ""
    with open_file(path, expected=expected, where=path.name) as source, to.open("wb") as target:
        try:
            for part in _parts(source):
                size += target.write(part)
        except zlib.error as error:
            damage = f", damaged behind that ({error})"
    if not size:
        raise DataError(f"contains nothing{damage}", where=path.name, expected=expected)
    decisions.add(path.name, f"unpacked: {size} bytes{damage}")
    return to


def _parts(source: BinaryIO) -> Iterator[bytes]:
    """Yield what was packed, also before damage: `gzip` drops the part in which that is."""
    decoder = zlib.decompressobj(_GZIP)
    rest = b""
    while rest := rest or source.read(_PART):
        if decoder.eof:
            # Packed files may stand one behind the other.
            decoder = zlib.decompressobj(_GZIP)
        yield decoder.decompress(rest, _PART)
        rest = decoder.unconsumed_tail or decoder.unused_data
    if not decoder.eof:
        raise zlib.error("it ends early")
