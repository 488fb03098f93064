"""Two results of one trial against each other and against the truth."""
