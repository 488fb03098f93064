"""Run the command line as a module."""

from __future__ import annotations

from factorgraph_dvl.cli import main

if __name__ == "__main__":
    main()
