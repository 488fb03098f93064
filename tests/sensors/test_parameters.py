"""Parameters: where trial.yaml states their standard deviations."""

from __future__ import annotations

import pytest

from factorgraph_dvl.sensors.catalogue import AIDS
from factorgraph_dvl.sensors.imu import Imu

STATED = [spec for kind in (Imu, *AIDS) for spec in kind.specs if spec.key]
SECTIONS = {kind.section: kind.section_type for kind in (Imu, *AIDS)}


@pytest.mark.parametrize("spec", STATED, ids=[spec.name for spec in STATED])
def test_the_key_of_a_parameter_is_one_of_trial_yaml(spec):
    section, _, key = spec.key.partition(": ")
    assert key in SECTIONS[section].__struct_fields__
