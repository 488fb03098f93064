"""Files that are read whole."""

from __future__ import annotations

import os

import pytest

from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.settings.files import read_bytes


def test_a_file_is_read(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_bytes(b"a: 1\n")
    assert read_bytes(path, limit=5, expected="settings") == b"a: 1\n"


def test_what_is_no_file_of_moderate_size_is_refused_with_its_reason(tmp_path):
    large = tmp_path / "large"
    large.write_bytes(b"x" * 2_000_001)
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path, said in (
        (large, "2 MB.*settings, at most 1 MB"),
        (pipe, "is a pipe or a device"),
        ("/dev/zero", "is a pipe or a device"),
        (tmp_path, "is a folder"),
        (tmp_path / "none", "does not exist"),
        (large / "below", "does not exist"),
        ("a\0b", "is not the name of a file"),
    ):
        with pytest.raises(DataError, match=said):
            read_bytes(path, limit=1_000_000, expected="settings")


def test_the_kind_of_error_is_the_callers(tmp_path):
    with pytest.raises(ConfigError, match="does not exist"):
        read_bytes(tmp_path / "none", limit=1, expected="settings", kind=ConfigError)
