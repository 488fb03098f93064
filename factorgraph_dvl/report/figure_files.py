"""Files that figures may have."""

# Formats of figures.
_KINDS = ("png", "svg", "pdf")


def figure_files(*names: str) -> tuple[str, ...]:
    """Return the files that figures may have, in all their formats."""
    return tuple(f"{name}.{kind}" for name in names for kind in _KINDS)
