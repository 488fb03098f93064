"""The account of a raw file: its records by type, read and skipped with the reason."""

from __future__ import annotations

from dataclasses import dataclass, field

from factorgraph_dvl.files.formats.losses import REPEATED, UNKNOWN_TYPE, Losses

# Share of a type above which what is left out is worth a warning.
_MUCH = 0.1
# What is skipped for these reasons is not lost.
_NO_LOSS = (UNKNOWN_TYPE, REPEATED)
_DAMAGED = "damaged"
_BYTE = "byte "


@dataclass
class Tally:
    """Records of one type.

    Parameters
    ----------
    read : int
        Those that can be used.
    skipped : dict of str to int
        The others, by the reason.
    """

    read: int = 0
    skipped: dict[str, int] = field(default_factory=dict)

    def skip(self, reason: str, count: int) -> None:
        """Count records that are skipped."""
        if count:
            self.skipped[reason] = self.skipped.get(reason, 0) + count

    @property
    def reasons(self) -> str:
        """The reasons as text, with counts if there are several; empty if nothing was skipped."""
        if len(self.skipped) == 1:
            return next(iter(self.skipped))
        return ", ".join(f"{reason}: {count}" for reason, count in self.skipped.items())


@dataclass(frozen=True)
class Account:
    """All records of one file.

    Parameters
    ----------
    file : str
        Its name.
    types : dict of str to Tally
        Tallies by type.
    """

    file: str
    types: dict[str, Tally]

    def include(self, losses: Losses) -> None:
        """Add what readers left out, and what they read for the sake of other records."""
        for kind, count in losses.used.items():
            self.types.setdefault(kind, Tally()).read += count
        for kind, reasons in losses.skipped.items():
            for reason, count in reasons.items():
                self.types.setdefault(kind, Tally()).skip(reason, count)
        for what, count in losses.counts.items():
            if not what.startswith(_BYTE):
                self.types.setdefault(_DAMAGED, Tally()).skip(what, count)

    def rows(self) -> list[tuple[str, int, int, str]]:
        """Return type, number read, number skipped and the reasons, for each type."""
        return [
            (kind, tally.read, sum(tally.skipped.values()), tally.reasons)
            for kind, tally in self.types.items()
        ]

    def lines(self) -> list[str]:
        """Return a line for each type, without the name of the file."""
        out = []
        for kind, read, skipped, reasons in self.rows():
            why = f" ({reasons})" if reasons else ""
            out.append(f"{kind}: {read} read, {skipped} skipped{why}")
        return out

    def warnings(self) -> list[str]:
        """Return what was left out of the types of which more than a tenth was."""
        total = sum(read + skipped for _, read, skipped, _ in self.rows())
        out = []
        for kind, tally in self.types.items():
            lost = sum(n for reason, n in tally.skipped.items() if reason not in _NO_LOSS)
            whole = total if kind == _DAMAGED else tally.read + sum(tally.skipped.values())
            if lost > _MUCH * whole:
                out.append(
                    f"{self.file}: {kind}: {lost} of {whole} records skipped ({tally.reasons})"
                )
        return out
