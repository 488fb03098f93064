"""What an import decided, and what is missing: lines of import.log."""

from __future__ import annotations

from dataclasses import dataclass, field

from factorgraph_dvl.errors import printable

LOG_FILE = "import.log"
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
        Of keys of trial.yaml, as `section.key`.
    missing : list of str
        What the trial lacks, with what would help.
    """

    lines: list[str] = field(default_factory=list)
    comments: dict[str, str] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)

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

    def text(self, digest: str) -> str:
        """Return the text of import.log, which ends with the digest of trial.yaml."""
        lines = [*self.lines, *(MISSING + text for text in self.missing), _DIGEST + digest]
        return "\n".join(lines) + "\n"


def digest_in(log: str) -> str:
    """Return the digest of trial.yaml as the import wrote it, empty if the log has none."""
    last = log.rstrip("\n").rpartition("\n")[2]
    return last.removeprefix(_DIGEST) if last.startswith(_DIGEST) else ""
