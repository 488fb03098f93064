"""Files of instruments, read into plain NumPy records; no module here knows of a trial."""
