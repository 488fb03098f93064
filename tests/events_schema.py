"""Write docs/events.schema.json, the schema of what `--json` prints."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorgraph_dvl.cli.events import schema

FILE = Path(__file__).parent.parent / "docs" / "events.schema.json"


def content() -> bytes:
    """Return the file's content."""
    return msgspec.json.format(msgspec.json.encode(schema()), indent=2) + b"\n"


if __name__ == "__main__":
    FILE.write_bytes(content())
