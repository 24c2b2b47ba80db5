"""Arguments of gym.make: wrong ones are refused before anything is made."""

import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import rare_envs
from rare_envs.envs.single import DrivingEnv
from rare_envs.measures import minimum


def test_bad_values_and_types_are_refused_at_the_door() -> None:
    for name, value in (
        ("observation", "features2"),
        ("action", "mega"),
        ("measure", "tcc"),
        ("base", "us102"),
        ("horizon", -1.0),
        ("dt", "0.1"),
        ("render_mode", "ansi"),
    ):
        with pytest.raises(ValueError, match=r"[Ee]xpected|Unknown|No traffic model|measure"):
            DrivingEnv("rare_envs/CutIn-v0", **{name: value})
    env = DrivingEnv("rare_envs/CutIn-v0")
    for options in ([], "abc", 3):
        with pytest.raises(ValueError, match="mapping"):
            env.reset(options=options)  # type: ignore[arg-type]
    for num_envs in (2.5, "3", 0):
        with pytest.raises(ValueError, match="num_envs"):
            gym.make_vec("rare_envs/CutIn-v0", num_envs)  # type: ignore[arg-type]


def test_an_unknown_keyword_is_named_with_the_nearest_known_one() -> None:
    with pytest.raises(TypeError, match=r"'horizn' \(did you mean 'horizon'"):
        gym.make("rare_envs/CutIn-v0", horizn=3.0)
    with pytest.raises(TypeError, match="reset takes it as an option"):
        gym.make("rare_envs/CutIn-v0", cut_in_gap=3.0)
    listed = "it takes ego, core, chunk_size, device, observation"
    with pytest.raises(TypeError, match=rf"'cor' \(did you mean 'core'\?\); {listed}"):
        rare_envs.DrivingProblem("rare_envs/CutIn-v0", cor="numba")


def test_the_configuration_of_highway_env_is_answered_by_our_arguments() -> None:
    for config in ({"duration": 5, "lanes_count": 3}, None):
        with pytest.raises(TypeError, match=r"in place of HighwayEnv's config: horizon \(duration\), dt"):
            rare_envs.DrivingProblem("rare_envs/CutIn-v0", config=config)


def test_a_measure_object_goes_with_an_ego_that_has_noise_of_its_own() -> None:
    """The measure is tried on the scenario's columns; those of the ego's noise stand behind them."""
    problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego="human", measure=minimum("ttc"), horizon=0.3)
    named = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego="human", measure="ttc", horizon=0.3)
    x = problem.base.sample(20, np.random.default_rng(0))
    assert problem.dim > 3
    assert problem.evaluate(x).tolist() == named.evaluate(x).tolist()


@pytest.mark.slow
def test_entries_say_their_version_and_no_version_of_the_package_is_called_out_of_date() -> None:
    """In a process of its own, with the warnings of a user's script: pytest has filters of its own."""
    assert {gym.registry[env_id].version for env_id in ("rare_envs/CutIn-v0", "rare_envs/CutIn-v1")} == {0, 1}
    script = (
        "import gymnasium as gym, rare_envs\n"
        "for env_id in ('rare_envs/CutIn-v0', 'rare_envs/CutIn-kinematics-v0', 'CartPole-v0'):\n"
        "    print(gym.make(env_id).spec.id)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["rare_envs/CutIn-v0", "rare_envs/CutIn-kinematics-v0", "CartPole-v0"]
    assert "CartPole-v0 is out of date" in done.stderr
    assert "rare_envs/" not in done.stderr


def test_a_class_or_a_function_of_a_module_in_the_working_directory_makes_what_a_name_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "made_here" / "inner").mkdir(parents=True)  # folders without __init__.py, as `python -m` finds them
    (tmp_path / "made_here" / "inner" / "parts.py").write_text(
        "import numpy as np\n"
        "from rare_envs.scenarios import find_scenario, load_base\n"
        "class Coasting:\n"
        "    def predict(self, observation, state=None, episode_start=None, deterministic=True):\n"
        "        return np.zeros((len(observation), 2), np.float32), None\n"
        "def make_base():\n"
        "    return load_base(find_scenario('cut_in'), 'i80')\n"
        "def gap(moment):\n"
        "    return moment.lead.gap.clamp(max=100.0)\n"
        "def broken(which):\n"
        "    return which\n"
    )
    monkeypatch.chdir(tmp_path)
    parts = "made_here.inner.parts"
    own = {"ego": f"{parts}:Coasting", "base": f"{parts}:make_base", "measure": f"{parts}:gap"}
    problem = rare_envs.DrivingProblem("cut_in", drivers=f"cutter={parts}:Coasting", **own)  # type: ignore[arg-type]
    x = rare_envs.DrivingProblem("cut_in", base="i80").base.sample(4, np.random.default_rng(0))
    np.testing.assert_array_equal(problem.base.sample(4, np.random.default_rng(0)), x)
    assert (problem.evaluate(x) <= 100.0).all() and problem.given == f"{parts}:Coasting drives the cutter"
    for name, kind in (("ego", "ego"), ("base", "traffic model"), ("drivers", "drivers")):
        with pytest.raises(ValueError, match=f"'{parts}:broken', called without .* failed to make the {kind}"):
            rare_envs.DrivingProblem("cut_in", **{name: f"{parts}:broken"})
    for name in [each for each in sys.modules if each.startswith("made_here")]:
        del sys.modules[name]
