"""Incremental smoothing of data as they arrive: collect, align, go."""
