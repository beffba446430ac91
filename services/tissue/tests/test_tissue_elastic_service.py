"""The elastic tissue in its role: by the command's choice, its truth, its cache."""

import numpy as np
import pytest

from palpate_bus.contract import MS, contract
from palpate_bus.implementations import create_for
from palpate_bus.messages import Point, Pose, Quaternion, ToolState, Twist, Vector3
from palpate_bus.messages.codec import decode, encode
from palpate_bus.messages.stamps import header
from palpate_bus.testing.hand_inbox import HandInbox
from palpate_models.patient.phantom import flat_phantom
from palpate_models.patient.schema import Lesion
from palpate_models.scenario.load import load_scenario
from palpate_tissue.backends.elastic.compliance import compliance
from palpate_tissue.backends.elastic.service import create

COARSE = ("phantom.edge_m=0.012", "phantom.lesions.0.depth_m=0.02", "phantom.lesions.0.radii_m=[0.06, 0.05]")


def tool_state(t, p, radius=0.015):
    pose = Pose(Point(*p), Quaternion(0.0, 0.0, 0.0, 1.0))
    return ToolState(header(t, "world"), pose, Twist(Vector3(0.0, 0.0, 0.0), Vector3(0.0, 0.0, 0.0)), radius)


def test_the_scenario_chooses_it():
    scenario = load_scenario("deep_lesion")
    assert scenario.phantom.lesions[0].depth_m == 0.008
    assert create_for("tissue", scenario.services.tissue) is create


def test_it_publishes_what_the_contract_says_and_presses_back():
    service = create(load_scenario("deep_lesion", COARSE), pitch_m=0.025)
    topics = {topic.name: topic for topic in contract().outputs("tissue")}
    assert set(service.start()) == {name for name, topic in topics.items() if topic.latched}
    inbox, sent = HandInbox(), {}
    for k in range(101):
        inbox.messages["sim/tool_state"] = tool_state(k * MS, (0.56 - 0.045, -0.045, 0.93 + 0.015 - 1e-4 * k))
        out = service.step(k * MS, inbox)
        assert set(out) == {name for name, topic in topics.items() if not topic.latched and k % topic.period_ms == 0}
        for name, message in out.items():
            sent[name] = decode(encode(message, topics[name].type), topics[name].type)
    assert sent["sim/contact_wrench"].wrench.force.z > 0.5
    truth = sent["truth/indentation"]
    assert truth.contacts > 0
    vertices = sent["sim/surface"].vertices.reshape(-1, 3)
    rest = decode(encode(service.start()["truth/phantom"], "palpation_msgs/msg/PhantomTruth"), "palpation_msgs/msg/PhantomTruth")
    moved = vertices - rest.surface.vertices.reshape(-1, 3) - (0.56, 0.0, 0.93)
    assert 0.003 < np.linalg.norm(moved, axis=1).max() < 0.0105
    assert rest.lesion.max() == 0  # labelled where it lies
    facts = service.finish()
    assert facts["contact_onsets"] == 1
    assert facts["lesion_depths_m"] == [0.02]


def test_the_wall_of_a_scenario_stiffens_and_is_guarded():
    def force(*settings):
        service = create(load_scenario("deep_lesion", (*COARSE, *settings)), pitch_m=0.025)
        inbox = HandInbox()
        for k in range(201):
            inbox.messages["sim/tool_state"] = tool_state(k * MS, (0.56 + 0.06, 0.06, 0.93 + 0.015 - 1e-4 * k))
            out = service.step(k * MS, inbox)
        return out["sim/contact_wrench"].wrench.force.z

    plain = force()
    assert force("phantom.stiffness.stiffening_per_m=150") > 1.1 * plain
    assert force("phantom.guarding=[{centre_m: [0.06, 0.06]}]") > 1.8 * plain


def test_a_second_start_reads_the_cache(monkeypatch):
    def refuse(*_):
        raise AssertionError("computed again")

    model = flat_phantom(0.045, 0.005)
    lesion = Lesion(centre_m=(0.0, 0.0), radii_m=(0.02, 0.02), depth_m=0.01)
    first = compliance(model, (lesion,), 0.05, pitch_m=0.02)
    monkeypatch.setattr("palpate_tissue.backends.elastic.compliance.skin_compliance", refuse)
    np.testing.assert_array_equal(compliance(model, (lesion,), 0.05, pitch_m=0.02).matrix, first.matrix)
    with pytest.raises(AssertionError, match="computed again"):
        compliance(model, (lesion.model_copy(update={"depth_m": 0.011}),), 0.05, pitch_m=0.02)
