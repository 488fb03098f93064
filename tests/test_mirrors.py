"""Tests mirror modules: where each module of the package is tested."""

from __future__ import annotations

import ast
from fnmatch import fnmatch
from pathlib import Path

import factorgraph_dvl

PACKAGE = Path(factorgraph_dvl.__file__).parent
TESTS = Path(__file__).parent
# Modules without a test module that bears their name or imports them, and where what they do is
# tested instead: they are parts of one thing, or stand behind a command or a catalogue.
ELSEWHERE = {
    "sensors/averaging": "solvers/test_averaging.py",
    "sensors/dvl_water": "solvers/test_water_span.py",
    "baselines/beam_calibration": "sensors/test_dvl_beams.py",
    "baselines/spurious_information": "baselines/test_calibration.py",
    "baselines/star_calibration": "sensors/test_star.py",
    "campaign/*": "campaign",
    "cli/allan": "analysis/test_static_noise.py",
    "cli/correct": "sensors/test_dvl_beams.py",
    "cli/deadreckon": "analysis/dead_reckoning/test_before_after.py",
    "cli/import_files": "files/importing/test_real_files.py",
    "cli/instrument": "analysis/test_instrument_terms.py",
    "cli/replay": "replay/test_session.py",
    "cli/report": "report",
    "cli/*": "cli/test_app.py",
    "geometry/celestial": "sensors/test_star.py",
    "geometry/records": "graph/test_problem.py",
    "geometry/units": "settings/test_ranges.py",
    "graph/bound_observation": "graph/test_problem.py",
    "graph/chain": "graph/test_smooth_chain.py",
    "graph/clocks": "solvers/test_clocks.py",
    "graph/imu_errors": "graph/test_problem.py",
    "graph/measurement_factors": "graph/test_problem.py",
    "graph/observation_rows": "sensors/test_protocol.py",
    "graph/processes": "solvers/test_correlated_noise.py",
    "imu/between_samples": "imu/test_two_way.py",
    "imu/gtsam_measurements": "imu/test_preintegration.py",
    "imu/attitude_record": "solvers/test_preparation_without_imu.py",
    "initialization/record_clocks": "solvers/test_preparation_without_imu.py",
    "initialization/track_velocity": "solvers/test_preparation_without_imu.py",
    "settings/certificate": "report/html/test_certificate.py",
    "statistics/information_history": "analysis/information/test_shares.py",
    "statistics/leverage": "statistics/test_rows.py",
    "statistics/spurious_information": "replay/test_session.py",
    "imu/arc_polynomials": "imu/test_increments.py",
    "files/corrected_record": "sensors/test_dvl_beams.py",
    "files/data_frames": "files",
    "files/exporting/bag": "files/exporting/test_trial.py",
    "files/exporting/pd0": "files/exporting/test_trial.py",
    "files/formats/vehicles/*": "files/formats/test_vehicles.py",
    "files/formats/catalogue": "files/importing",
    "files/formats/*": "files/formats",
    "files/formats/pd0_navigation": "files/formats/test_pd0.py",
    "files/formats/sentences": "files/formats/test_nmea.py",
    "files/importing/*": "files/importing",
    "files/run_file": "files",
    "estimates": "test_solution.py",
    "message": "quality/test_texts.py",
    "plausibility/dvl": "plausibility/test_survey.py",
    "plausibility/gnss": "plausibility/test_survey.py",
    "plausibility/imu": "plausibility/test_survey.py",
    "plausibility/record*": "plausibility/test_survey.py",
    "plausibility/*": "plausibility/test_consistency.py",
    "quality/notation": "report",
    "quality/results": "test_solution.py",
    "quality/star_catalogue": "sensors/test_star.py",
    "replay/initializer": "replay/test_session.py",
    "replay/playback": "replay/test_session.py",
    "replay/record_navigator": "replay/test_navigator_without_imu.py",
    "report/figures/beams": "sensors/test_dvl_beams.py",
    "report/figures/crosscheck": "cli/test_crosscheck.py",
    "report/figures/dead_reckoning": "analysis/dead_reckoning/test_before_after.py",
    "report/figures/static_noise": "analysis/test_static_noise.py",
    "report/figures/*": "report/figures/test_solution.py",
    "report/files/convergence": "replay/test_session.py",
    "report/certificate": "report/html/test_certificate.py",
    "report/check": "report/test_pdf.py",
    "report/files/check": "analysis/dead_reckoning/test_check.py",
    "report/vessel": "report/html/test_vessel.py",
    "report/*crosscheck*": "cli/test_crosscheck.py",
    "report/files/dead_reckoning": "analysis/dead_reckoning/test_before_after.py",
    "report/html/*": "report",
    "report/figure_files": "report",
    "report/observability_tables": "cli/test_observability.py",
    "report/table*": "report/terminal/test_tables.py",
    "reproduce/*": "cli/test_reproduce.py",
    "sensors/attitude": "sensors",
    "sensors/beam_model": "sensors/test_dvl_beams.py",
    "sensors/ins": "sensors",
    "sensors/turntable*": "sensors/test_dvl_beams.py",
    "settings/sections": "settings/test_yaml_file.py",
    "simulation/*": "simulation/test_measurements.py",
    "solvers/change_along_trial": "solvers",
    "solvers/heading_and_misalignment": "solvers/test_preparation_without_imu.py",
    "solvers/model": "solvers/test_rounds.py",
    "solvers/prediction": "planning/test_prediction.py",
    "solvers/steps": "solvers/test_rounds.py",
    "solvers/true_times": "solvers/test_preparation_without_imu.py",
}
MODULES = sorted(
    path.relative_to(PACKAGE).with_suffix("").as_posix()
    for path in PACKAGE.rglob("*.py")
    if not path.stem.startswith("__")
)


def imported_by_tests() -> set[str]:
    """Return the modules that tests import, as paths without suffix."""
    out = set()
    for path in TESTS.rglob("test_*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
                out |= {name.removeprefix("factorgraph_dvl.").replace(".", "/") for name in names}
    return out


def mirrored(module: str) -> bool:
    """Whether a test module stands where the module stands."""
    folder, _, name = module.rpartition("/")
    return (TESTS / folder / f"test_{name}.py").exists()


def test_every_module_is_tested_by_its_name_or_where_it_is_said():
    imported = imported_by_tests()
    homeless = [
        module
        for module in MODULES
        if not mirrored(module)
        and module not in imported
        and not any(fnmatch(module, pattern) for pattern in ELSEWHERE)
    ]
    assert not homeless, "without a test module; give them one, or name it in ELSEWHERE"


def test_what_is_named_is_there():
    assert [where for where in ELSEWHERE.values() if not (TESTS / where).exists()] == []
    unused = [p for p in ELSEWHERE if not any(fnmatch(module, p) for module in MODULES)]
    assert unused == []


def test_modules_of_the_core_have_their_own_or_are_named():
    core = ("geometry", "graph", "imu", "initialization", "replay", "solvers", "statistics")
    without = [
        module
        for module in MODULES
        if module.split("/")[0] in core
        and not mirrored(module)
        and not any(fnmatch(module, pattern) for pattern in ELSEWHERE)
    ]
    assert not without, "that a test imports them is not enough"
