"""Settings of all tests."""

import os

# Workers share the cores: threads of linear algebra would only wait for one another.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
