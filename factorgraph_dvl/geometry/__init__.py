"""Units, vectors, rotations, the Earth and the sky."""
