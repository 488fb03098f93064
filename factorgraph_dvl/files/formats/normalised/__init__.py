"""Records of the readers in the common terms of `format`."""
