import pytest

from agents import load_driver, read_driver, read_provenance
from training.data import scenes_of, synthetic_traffic
from training.imitation.collision_avoidance import add_avoidance, write_driver
from training.imitation.noise_damping import damp_acceleration
from training.imitation.traffic.recording import stack_scenes


def test_a_driver_gets_the_rule_and_less_damped_noise(tmp_path):
    test = stack_scenes(scenes_of(synthetic_traffic(seconds=6.0), seconds=6.0))
    out = write_driver("mgail", 0.4, test, tmp_path / "ruled.safetensors")
    made, plain = read_driver(out), load_driver("mgail")
    assert made.name == "ruled"
    assert made.avoidance == add_avoidance(plain, 0.4, "ruled").avoidance
    assert made.colour == damp_acceleration(plain.colour, 0.4)
    assert made.weights.dim == plain.weights.dim
    provenance = read_provenance(out)
    assert provenance.kind == "mgail, rule of collision avoidance"
    assert provenance.command.endswith("--driver mgail --damping 0.4 --out OUT")
    assert set(provenance.metrics) == {"10 s", "20 s"}


def test_a_rule_alone_is_refused(tmp_path):
    with pytest.raises(ValueError, match="Expected a learned driver, got the rule 'idm'"):
        write_driver("idm", 0.4, None, tmp_path / "ruled.safetensors")
