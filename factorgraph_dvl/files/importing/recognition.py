"""Which formats a raw file is in, by its content."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.files.formats.catalogue import FORMATS
from factorgraph_dvl.files.formats.format import Format
from factorgraph_dvl.files.formats.framing import Source, map_file

# Bytes from the start, and as many from the middle, in which formats are looked for. Chosen: some
# minutes of a log, read in milliseconds.
_SAMPLE = 1 << 20
# Share of the sample below which a format is there by chance. Chosen: a checksum of two digits
# fits one line in 256.
_LEAST_SHARE = 0.01
# Bytes and lines by which a table is known. Chosen: a header and some rows.
_TABLE_SAMPLE, _TABLE_LINES = 65536, 5


def by_name(name: str) -> Format:
    """Return a format by its name.

    Raises
    ------
    ConfigError
        If there is none of that name.
    """
    for found in FORMATS:
        if found.name == name:
            return found
    names = ", ".join(sorted(known.name for known in FORMATS))
    raise ConfigError(f"there is no format `{name}`", where="--format", expected=f"one of {names}")


def recognise(path: Path) -> tuple[Format, ...]:
    """Return the formats of a file: one, or several whose records stand in one text.

    The format that explains the largest share of a sample is taken; the name's ending decides
    between equal ones.

    Parameters
    ----------
    path : Path
        A file, or the folder of a ROS 2 bag.

    Raises
    ------
    DataError
        If no format explains the file.
    """
    sample = b"" if path.is_dir() else sample_of(map_file(path))
    ending = path.suffix.lower()
    shares = {known: known.share(path, sample) for known in FORMATS}
    best = max(FORMATS, key=lambda known: (shares[known], ending in known.endings))
    if shares[best] < _LEAST_SHARE:
        raise _unknown(path, sample)
    if not best.in_text:
        return (best,)
    return tuple(known for known in FORMATS if known.in_text and shares[known] >= _LEAST_SHARE)


def _unknown(path: Path, sample: bytes) -> DataError:
    """Return what to say of a file that no format explains."""
    where = path.name
    if path.is_dir():
        return DataError("a folder, and not the bag of a ROS 2 system", where=where,
                         expected="files of instruments")  # fmt: skip
    if not sample:
        return DataError("the file is empty", where=where)
    if is_table(sample):
        return DataError(
            "a table whose columns are not known",
            where=where,
            hint=f"Run `factorgraph-dvl import --guess {where}` first: it proposes a mapping of "
            f"the columns. Then `import {where} --map MAPPING.yaml --out TRIAL`",
        )
    return DataError(
        "not an instrument's file", where=where, expected="one of the formats in docs/formats.md"
    )


def is_table(sample: bytes) -> bool:
    """Return whether bytes look like a table: lines of text with as many delimiters each."""
    try:
        text = sample[:_TABLE_SAMPLE].decode("utf-8-sig", errors="strict")
    except UnicodeDecodeError as error:
        # The sample may end within a character.
        if error.start < min(len(sample), _TABLE_SAMPLE) - 4:
            return False
        text = sample[: error.start].decode("utf-8-sig")
    # The last line may be cut.
    lines = [line for line in text.splitlines() if line.strip()][:_TABLE_LINES]
    return len(lines) > 1 and any(
        lines[0].count(sign) > 0 and len({line.count(sign) for line in lines}) == 1
        for sign in ",;\t"
    )


def sample_of(source: Source) -> bytes:
    """Return the first bytes of a file, and as many from its middle."""
    middle = max(_SAMPLE, len(source) // 2)
    return source[:_SAMPLE] + source[middle : middle + _SAMPLE]


def check_installed(found: Format, path: Path) -> None:
    """Raise ConfigError if a format needs a module that is not installed."""
    if found.module and find_spec(found.module) is None:
        raise ConfigError(
            f"{found.title} needs the Python package of `{found.module}`",
            where=path.name,
            hint=f"Install it: pip install 'factorgraph-dvl[{found.extra}]'",
        )
