"""The formats of raw files: a new one is known once it stands here."""

from __future__ import annotations

from factorgraph_dvl.io.formats.format import Format

FORMATS: tuple[Format, ...] = ()
