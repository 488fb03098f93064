"""Raw files into a trial folder, from their bytes to trial.yaml and import.log."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from factorgraph_dvl.errors import DataError, as_text
from factorgraph_dvl.files.folders import SETTINGS_FILE, claim, new_folder
from factorgraph_dvl.files.formats.format import Format
from factorgraph_dvl.files.formats.framing import map_file
from factorgraph_dvl.files.formats.losses import Losses
from factorgraph_dvl.files.formats.mapping import MappingSettings
from factorgraph_dvl.files.formats.sentences import text_losses
from factorgraph_dvl.files.formats.table import FORMAT as TABLE
from factorgraph_dvl.files.importing.account import Account
from factorgraph_dvl.files.importing.acoustic import located
from factorgraph_dvl.files.importing.assembly import (
    SUFFIX,
    assemble,
    digest,
    write_tables,
    yaml_text,
)
from factorgraph_dvl.files.importing.decisions import LOG_FILE, Decisions, digest_in
from factorgraph_dvl.files.importing.packed import unpacked
from factorgraph_dvl.files.importing.recognition import by_name, check_installed, recognise
from factorgraph_dvl.files.importing.spool import Spool
from factorgraph_dvl.files.importing.time_base import on_utc

NEW_SETTINGS = "trial.yaml.new"
_SECTIONS = ("imu", "ins", "gnss", "usbl", "ship", "attitude", "dvl", "dvl_beams", "depth")
# The log first: a folder without it was not written by an import.
OWNED = (LOG_FILE, SETTINGS_FILE, NEW_SETTINGS, *(name + SUFFIX for name in _SECTIONS))
_SPOOL = ".spool"
# Types of records that an error names.
_SHOWN = 8

Progress = Callable[[str], None]


def import_files(
    files: Sequence[Path],
    out: Path,
    *,
    form: str = "",
    mapping: MappingSettings | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Decisions:
    """Import raw files of one trial.

    Parameters
    ----------
    files : sequence of path-like
        Files in any order; their names do not matter. Those that end in `.gz` are unpacked.
    out : path-like
        Trial folder to write.
    form : str, optional
        Name of the format of all files; by default each is recognised by its content.
    mapping : MappingSettings, optional
        What the columns of tables are, and what else trial.yaml is to say.
    force : bool, default False
        Replace the tables of an earlier import; a trial.yaml that was edited stays, and what it
        would be is written beside it.
    progress : callable, optional
        Called with a line about what is being done.

    Returns
    -------
    Decisions
        What was found, done, and is missing: the content of import.log.

    Raises
    ------
    ConfigError, DataError
        If a file is in no known format, or files cannot be related to each other.
    """
    decisions = Decisions()
    say = progress or (lambda text: None)
    kept = edited_settings(out)
    with (
        claim(out, force=force, owned=OWNED, inputs=files),
        unpacked([Path(path) for path in files], decisions) as paths,
    ):
        formats = [_formats_of(path, form, mapping) for path in paths]
        with new_folder(out, force=force, owned=OWNED) as folder:
            spool_folder = folder / _SPOOL
            spool_folder.mkdir()
            spool = Spool(spool_folder, decisions.add, decisions.warn)
            useless = [
                error
                for path, found in zip(paths, formats, strict=True)
                if (error := _read(path, found, spool, mapping, decisions, say)) is not None
            ]
            if len(useless) == len(files):
                raise useless[0]
            for error in useless:
                decisions.warn(f"{error.where}: {error.what}")
            _mention_settings([Path(path) for path in files], formats, decisions)
            whose = {} if mapping is None else mapping.sentences
            streams = on_utc(spool.streams(), spool, decisions)
            streams = located(streams, spool, decisions, whose)
            say("assemble")
            name = as_text(paths[0].stem)
            assembly, epoch = assemble(streams, name, decisions)
            _override(assembly.settings, {} if mapping is None else mapping.trial)
            write_tables(assembly, epoch, folder)
            shutil.rmtree(spool_folder)
            text = yaml_text(assembly.settings, decisions.comments).encode()
            (folder / SETTINGS_FILE).write_bytes(text if kept is None else kept)
            if kept is not None:
                (folder / NEW_SETTINGS).write_bytes(text)
                decisions.add(
                    SETTINGS_FILE,
                    f"edited since the last import → kept; the new one is in {NEW_SETTINGS}",
                )
            (folder / LOG_FILE).write_text(decisions.text(digest(text)), encoding="utf-8")
    return decisions


def edited_settings(out: Path) -> bytes | None:
    """Return the trial.yaml of an earlier import if it was edited since, else None."""
    settings, log = out / SETTINGS_FILE, out / LOG_FILE
    if not (settings.is_file() and log.is_file()):
        return None
    text = settings.read_bytes()
    same = digest(text) == digest_in(log.read_text(encoding="utf-8", errors="replace"))
    return None if same else text


def _mention_settings(
    files: Sequence[Path], formats: Sequence[tuple[Format, ...]], decisions: Decisions
) -> None:
    """Name files of WinRiver that lie beside a PD0 file and were not given."""
    given = {file.resolve() for file in files}
    folders = {
        path.parent
        for path, found in zip(files, formats, strict=True)
        if any(form.name == "pd0" for form in found)
    }
    for folder in sorted(folders):
        for beside in sorted(folder.glob("*.mmt")):
            if beside.resolve() not in given:
                decisions.add(beside.name, "lies beside and was not given: it may say more")


def _formats_of(path: Path, form: str, mapping: MappingSettings | None) -> tuple[Format, ...]:
    found: tuple[Format, ...]
    if form:
        found = (by_name(form),)
    elif mapping is not None and mapping.of(path):
        found = (TABLE,)
    else:
        found = recognise(path)
    for one in found:
        check_installed(one, path)
    return found


def _read(
    path: Path,
    formats: tuple[Format, ...],
    spool: Spool,
    mapping: MappingSettings | None,
    decisions: Decisions,
    say: Progress,
) -> DataError | None:
    """Read a file; return the error if it contains nothing, which other files may make up for."""
    size = path.stat().st_size
    decisions.add(path.name, " and ".join(form.title for form in formats) + f", {size} bytes")
    # Text is looked through once, whatever formats stand in it.
    losses = Losses()
    if formats[0].in_text:
        losses = text_losses(map_file(path), [form.addresses for form in formats])
    plain = None if mapping is None else msgspec.to_builtins(mapping)
    for form in formats:
        if form.limit:
            say(f"{path.name}: {form.limit}")
        for batch in form.read(path, plain):
            spool.append(path.name, form.name, batch)
            if batch.losses is not None:
                losses.include(batch.losses)
            if len(batch.records):
                done = min(int(batch.records["at"][-1]) / max(size, 1), 1.0)
                say(f"read {path.name}, {100.0 * done:.0f} %")
    if damage := str(losses):
        decisions.add(path.name, f"{damage} → left out")
    account = Account(path.name, spool.tallies(path.name))
    has_records = bool(account.types)
    account.include(losses)
    decisions.accounts.append(account)
    for text in account.warnings():
        decisions.warn(text)
    if has_records:
        return None
    return DataError(
        "contains no data that a trial can use",
        where=path.name,
        expected="velocities, positions, attitude, depth, or the samples of an IMU",
        hint="; ".join(account.lines()[:_SHOWN]),
    )


def _override(settings: dict[str, Any], stated: Mapping[str, Any]) -> None:
    """Take over what a mapping states of trial.yaml."""
    for section, content in stated.items():
        if isinstance(content, Mapping) and isinstance(settings.get(section), dict):
            _override(settings[section], content)
        else:
            settings[section] = content
