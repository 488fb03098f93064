"""The report on paper: three pages of A4."""
