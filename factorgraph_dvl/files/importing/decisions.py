"""What an import decided, and what is missing: lines of import.log."""

from __future__ import annotations

from dataclasses import dataclass, field

from factorgraph_dvl.errors import printable
from factorgraph_dvl.files.importing.account import Account

LOG_FILE = "import.log"
WARNING = "warning: "
MISSING = "missing: "
_DIGEST = "trial.yaml sha256 "


@dataclass
class Decisions:
    """Decisions in their order, each once.

    Parameters
    ----------
    lines : list of str
        `subject: what was found → what was done`.
    comments : dict of str to str
        Comments of keys of trial.yaml, as `section.key`.
    missing : list of str
        What the trial lacks, with what would help.
    accounts : list of Account
        Records of each file by type, read and skipped.
    warnings : list of str
        What of a file was left out, or kept against its status.
    """

    lines: list[str] = field(default_factory=list)
    comments: dict[str, str] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)
    accounts: list[Account] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def add(self, subject: str, text: str, *keys: str) -> None:
        """Note a decision, and the keys of trial.yaml that it stands behind."""
        line = printable(f"{subject}: {text}")
        if line not in self.lines:
            self.lines.append(line)
        for key in keys:
            self.comments[key] = line

    def lack(self, text: str) -> None:
        """Note what is missing."""
        self.missing.append(printable(text))

    def warn(self, text: str) -> None:
        """Note what the user must know of a file."""
        self.warnings.append(printable(text))

    def text(self, digest: str) -> str:
        """Return the text of import.log, which ends with the digest of trial.yaml."""
        records = (
            printable(f"{account.file}: records: {line}")
            for account in self.accounts
            for line in account.lines()
        )
        warnings = (WARNING + text for text in self.warnings)
        missing = (MISSING + text for text in self.missing)
        lines = [*self.lines, *records, *warnings, *missing, _DIGEST + digest]
        return "\n".join(lines) + "\n"


def digest_in(log: str) -> str:
    """Return the digest of trial.yaml as the import wrote it, empty if the log has none."""
    last = log.rstrip("\n").rpartition("\n")[2]
    return last.removeprefix(_DIGEST) if last.startswith(_DIGEST) else ""
