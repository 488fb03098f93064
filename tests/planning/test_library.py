from __future__ import annotations

import msgspec
import pytest
from plans import CALM
from truth import scenario

from factorgraph_dvl.planning.proposal import library
from factorgraph_dvl.simulation import plan_motion


def test_every_entry_of_the_library_is_feasible_from_its_end():
    for start in (0.0, 3.0):
        scene = scenario(start={"speed_m_s": start}, manoeuvres=[{"straight_s": 10}], **CALM)
        found = library(scene, start)
        assert (found.under_way is None) == (start > 0.0)
        before = [] if found.under_way is None else list(found.under_way.manoeuvres)
        for item in found.items:
            twice = [*scene.manoeuvres, *before, *item.manoeuvres, *item.manoeuvres]
            motion = plan_motion(msgspec.structs.replace(scene, manoeuvres=twice))
            extra = 0.0 if found.under_way is None else found.under_way.duration
            assert motion.duration == pytest.approx(10.0 + extra + 2.0 * item.duration)
