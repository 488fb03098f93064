"""Messages of bags that were cut or damaged: MCAP files and ROS 1 bags, without their index.

Sources: the specifications of MCAP and of the format ROSBAG V2.0. Chunks are taken whole or
not at all; between them, the next one that is whole is searched for.
"""

from __future__ import annotations

import bz2
import re
import struct
import sys
from collections.abc import Iterator
from typing import Any, NamedTuple
from zlib import crc32

from factorgraph_dvl.files.formats.framing import Source
from factorgraph_dvl.files.formats.vehicles.library import load

ROS_1, MCAP = b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n"
# Larger chunks than this are none: recorders write a few megabytes.
_LARGEST = 1 << 28
# Fields in front of a record of ROS 1 have some hundred bytes, a chunk's less.
_LONGEST_FIELDS = 1 << 16
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _LAST = 3, 4, 5, 6, 15
_MCAP_CHUNK = re.compile(rb"\x06.{36}(?:\0\0\0\0|\x03\0\0\0lz4|\x04\0\0\0zstd)", re.DOTALL)
_BAG_MESSAGE, _BAG_CHUNK, _BAG_CONNECTION = 2, 5, 7
_BAG_FIELD = re.compile(rb"compression=(?:none|bz2|lz4)|op=\x05")


class Channel(NamedTuple):
    """Where messages were published.

    Parameters
    ----------
    topic, kind : str
        Name and type of the messages, `package/msg/Name`.
    definition : str
        Text of the type's definition.
    encoding : str
        Encoding of the definition: `ros1msg`, `ros2msg`, `ros2idl`.
    """

    topic: str
    kind: str
    definition: str
    encoding: str


# Channel, time of recording in ns, content.
Found = tuple[Channel, int, bytes]


def whole_messages(source: Source) -> Iterator[Found]:
    """Find the messages in chunks that are whole, and those outside chunks.

    Parameters
    ----------
    source : Source
        An MCAP file or a ROS 1 bag; nothing is found in others.

    Yields
    ------
    Channel, time of recording in ns, and content of each message, in the order of the file.
    """
    if source[: len(MCAP)] == MCAP:
        yield from _in_mcap(source)
    elif source[: len(ROS_1)] == ROS_1:
        yield from _in_bag(source)


def _decompressed(name: str, data: bytes, size: int) -> bytes | None:
    """Return a chunk of `size` bytes, None if it is not whole."""
    if size > _LARGEST:
        return None
    if name in ("", "none"):
        return data if len(data) == size else None
    tool: Any
    if name == "bz2":
        tool = bz2.BZ2Decompressor()
    elif name == "lz4":
        tool = load("lz4.frame", "bags").LZ4FrameDecompressor()
    else:
        place = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"
        tool = load(place, "bags").ZstdDecompressor()
    try:
        # Never more than was stated, whatever the compressed bytes expand to.
        out = bytes(tool.decompress(data, max_length=size))
    except Exception:  # Each of the three libraries has its own errors.
        return None
    return out if len(out) == size else None


# --- MCAP: operation, length, content ------------------------------------------------------------


def _in_mcap(source: Source) -> Iterator[Found]:
    schemas: dict[int, tuple[str, str, str]] = {}
    channels: dict[int, Channel] = {}
    at, size = len(MCAP), len(source)
    while 0 <= at <= size - 9:
        operation, length = struct.unpack("<BQ", source[at : at + 9])
        stop = at + 9 + length
        follows = stop == size or (stop < size and 1 <= source[stop] <= _LAST)
        records: bytes | None = None
        if 1 <= operation <= _LAST and follows:
            if operation == _CHUNK:
                records = _mcap_chunk(source[at + 9 : stop]) if length <= _LARGEST else None
            elif operation in (_SCHEMA, _CHANNEL, _MESSAGE):
                records = source[at:stop]
            else:
                records = b""
        if records is None:
            match = _MCAP_CHUNK.search(source, at + 1)
            at = match.start() if match else size
            continue
        yield from _mcap_messages(records, schemas, channels)
        # What closes a file looks like no record.
        at = stop


def _mcap_chunk(content: bytes) -> bytes | None:
    """Return the records in a chunk, None if it is not whole."""
    if len(content) < 40:
        return None
    size, check, name_length = struct.unpack_from("<QII", content, 16)
    start = 32 + name_length + 8
    if start > len(content) or name_length > 4:
        return None
    (length,) = struct.unpack_from("<Q", content, start - 8)
    if start + length != len(content):
        return None
    name = content[32 : 32 + name_length].decode("latin-1")
    records = _decompressed(name, content[start:], size)
    return records if records is not None and check in (0, crc32(records)) else None


def _mcap_messages(
    records: bytes, schemas: dict[int, tuple[str, str, str]], channels: dict[int, Channel]
) -> Iterator[Found]:
    at = 0
    while at <= len(records) - 9:
        operation, length = struct.unpack_from("<BQ", records, at)
        content = records[at + 9 : at + 9 + length]
        at += 9 + length
        if len(content) < length:
            return
        if operation == _MESSAGE and length >= 22:
            number, _, time = struct.unpack_from("<HIQ", content)
            if number in channels:
                yield channels[number], time, content[22:]
        elif operation == _SCHEMA and length >= 2:
            name, encoding, text = _strings(content, 2, 3)
            schemas[int.from_bytes(content[:2], "little")] = name, encoding, text
        elif operation == _CHANNEL and length >= 4:
            number, schema = struct.unpack_from("<HH", content)
            (topic,) = _strings(content, 4, 1)
            name, encoding, text = schemas.get(schema, ("", "", ""))
            channels[number] = Channel(topic, name, text, encoding)


def _strings(content: bytes, at: int, count: int) -> list[str]:
    out = []
    for _ in range(count):
        length = int.from_bytes(content[at : at + 4], "little")
        out.append(content[at + 4 : at + 4 + length].decode("utf-8", "replace"))
        at += 4 + length
    return out


# --- ROS 1: length of fields, fields `name=value`, length of content, content --------------------


def _in_bag(source: Source) -> Iterator[Found]:
    channels: dict[int, Channel] = {}
    at = len(ROS_1)
    while 0 <= at < len(source):
        record = _bag_record(source, at)
        records: bytes | None = None
        if record is not None:
            fields, start, stop = record
            operation = fields.get(b"op", b"")
            records = b""
            if operation == bytes([_BAG_CHUNK]):
                name = fields.get(b"compression", b"").decode("latin-1")
                size = int.from_bytes(fields.get(b"size", b""), "little")
                records = _decompressed(name, source[start:stop], size)
            elif operation == bytes([_BAG_CONNECTION]):
                records = source[at:stop]
        if record is None or records is None:
            match = _BAG_FIELD.search(source, at + 9)
            # The length of the fields and that of the first one stand before it.
            at = match.start() - 8 if match else len(source)
            continue
        yield from _bag_messages(records, channels)
        at = record[2]


def _bag_record(data: Source, at: int) -> tuple[dict[bytes, bytes], int, int] | None:
    """Return fields, and start and stop of the content of the record at a position, or None."""
    head = int.from_bytes(data[at : at + 4], "little")
    if not 0 < head <= _LONGEST_FIELDS or at + 8 + head > len(data):
        return None
    fields = {}
    text = data[at + 4 : at + 4 + head]
    place = 0
    while place < head:
        length = int.from_bytes(text[place : place + 4], "little")
        name, equals, value = text[place + 4 : place + 4 + length].partition(b"=")
        place += 4 + length
        if not equals or place > head:
            return None
        fields[name] = value
    start = at + 8 + head
    stop = start + int.from_bytes(data[start - 4 : start], "little")
    return (fields, start, stop) if stop <= len(data) else None


def _bag_messages(records: bytes, channels: dict[int, Channel]) -> Iterator[Found]:
    at = 0
    while (record := _bag_record(records, at)) is not None:
        fields, start, at = record
        number = int.from_bytes(fields.get(b"conn", b""), "little")
        operation = fields.get(b"op", b"")
        if operation == bytes([_BAG_MESSAGE]) and number in channels:
            seconds, nanoseconds = struct.unpack(
                "<II", fields.get(b"time", b"")[:8].ljust(8, b"\0")
            )
            yield channels[number], seconds * 1_000_000_000 + nanoseconds, records[start:at]
        elif operation == bytes([_BAG_CONNECTION]):
            channels[number] = _connection(fields, records[start:at])


def _connection(fields: dict[bytes, bytes], content: bytes) -> Channel:
    # Its content is fields again, without a length in front.
    record = _bag_record(len(content).to_bytes(4, "little") + content + bytes(4), 0)
    inner = record[0] if record else {}
    kind = inner.get(b"type", b"").decode("utf-8", "replace").replace("/", "/msg/")
    text = inner.get(b"message_definition", b"").decode("utf-8", "replace")
    return Channel(fields.get(b"topic", b"").decode("utf-8", "replace"), kind, text, "ros1msg")
