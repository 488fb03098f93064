"""SBET with the standard deviations of its smrmsg file."""

from __future__ import annotations

import format_samples as samples
import format_writers as writers
import numpy as np
import pyarrow.parquet

from factorgraph_dvl.files.importing.raw_files import import_files
from factorgraph_dvl.files.importing.recognition import recognise


def test_smrmsg_gives_sbet_its_standard_deviations(tmp_path):
    trajectory, errors = tmp_path / "sbet.out", tmp_path / "smrmsg.out"
    trajectory.write_bytes(writers.sbet(samples.rows(400)))
    rows = samples.deviations(10)
    rows[:, 1] = 0.2 + 0.1 * np.arange(10)
    errors.write_bytes(rows.tobytes())
    assert [form.name for form in recognise(trajectory)] == ["sbet"]
    assert [form.name for form in recognise(errors)] == ["smrmsg"]
    out = tmp_path / "trial"
    import_files([errors, trajectory], out)
    table = pyarrow.parquet.read_table(out / "ins.parquet").to_pydict()
    # Trajectory at 200 Hz, deviations at 1 Hz: north grows by 0.1 m/s between its records.
    np.testing.assert_allclose(table["std_n_m"], 0.2 + 0.1 * 0.005 * np.arange(400), atol=1e-9)
    np.testing.assert_allclose(table["std_e_m"], 0.1)
    np.testing.assert_allclose(table["vel_std_u_m_s"], 0.03)
    np.testing.assert_allclose(table["heading_std_deg"], 3.0 / 60.0)
    assert "position_std_m" not in (out / "trial.yaml").read_text()
