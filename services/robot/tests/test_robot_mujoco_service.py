"""The service with MuJoCo behind it: it conforms, and its arm goes where DART's goes under the same commands."""

import numpy as np
import pytest

from palpate.check.rig import RigSettings, ServiceRig
from palpate.check.suites import check
from palpate_bus.contract import MS
from palpate_models.robot import lbr
from palpate_models.scenario.load import load_scenario
from palpate_robot.backends.mujoco.service import create


@pytest.mark.slow
def test_it_conforms_to_the_role_robot() -> None:
    scenario = load_scenario("clean")
    report = check(ServiceRig(create(scenario), RigSettings(scenario, 0.0, True)))
    assert report.passed, [result for result in report.results if result.verdict == "failed"]


def test_it_starts_at_home_and_says_what_it_is() -> None:
    service = create(load_scenario("clean"))
    assert service.start()["robot_description"].data == lbr.urdf(load_scenario("clean").robot)
    rig = ServiceRig(service, RigSettings(load_scenario("clean"), 0.0, True))
    rig.run(0.01, {})
    assert rig.t > 5 * MS
    np.testing.assert_allclose(rig.last("joint_states").position, lbr.HOME, atol=1e-4)
