"""The table of lines per capability."""

from __future__ import annotations

from lines_per_capability import capability_of, code_lines, modules_now

SOURCE = '''"""Of a module.

Two lines more.
"""

# A comment.
X = (
    1,
)


def f():
    """Of a function."""
    return "text"  # and a comment
'''


def test_blank_lines_comments_and_docstrings_do_not_count():
    assert code_lines(SOURCE) == 5


def test_every_module_belongs_to_a_capability():
    assert {capability_of(name, 2) for name in modules_now()}
